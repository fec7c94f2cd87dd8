"""docs/configure.md: its commands run and print what the page says."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

from tests.support.pages import ROOT, Shell, commands, shell

pytestmark = pytest.mark.net

PAGE = (ROOT / "docs" / "configure.md").read_text()
BLOCK = re.compile(r"```(yaml|console)\n(.*?)```", re.DOTALL)


@pytest.fixture
def reader() -> Iterator[Shell]:
    with shell() as made:
        yield made


def test_configure_page_commands_print_the_shown_output(reader: Shell) -> None:
    for kind, text in BLOCK.findall(PAGE):
        if kind == "yaml":
            name = text.partition("\n")[0].removeprefix("# ")
            (reader.folder / name).write_text(text)
            continue
        for command, expected in commands(text):
            assert reader.run(command) == expected, command
