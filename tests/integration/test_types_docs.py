"""docs/types.md: its plant runs, its commands print what the page says, its program works."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from importlib.util import find_spec

import pytest

from tests.support.appliance import wait_until
from tests.support.pages import ROOT, Shell, commands, shell

pytestmark = pytest.mark.net

PAGE = (ROOT / "docs" / "types.md").read_text()
BLOCK = re.compile(r"```(yaml|console|python)\n(.*?)```", re.DOTALL)


@pytest.fixture
def reader() -> Iterator[Shell]:
    with shell() as made:
        yield made


def test_types_page_commands_print_the_shown_output(reader: Shell) -> None:
    for kind, text in BLOCK.findall(PAGE):
        if kind == "yaml":
            name = text.partition("\n")[0].removeprefix("# ")
            (reader.folder / name).write_text(text)
        elif kind == "python":
            if "pyads" in text and find_spec("pyads") is None:
                continue
            (reader.folder / "program.py").write_text(text)
            printed = reader.run(f"{sys.executable} program.py")
            # AdsLib in pyads says so of each connection that ends.
            assert re.sub(r".* Info: connection closed by remote\n", "", printed) == ""
        else:
            for command, expected in commands(text):
                check(reader, command, plain(expected))


def check(reader: Shell, command: str, expected: str) -> None:
    """Run *command*; wait for what it prints if that has to arrive from another station."""
    if "watch" in command:
        wait_until(lambda: plain(reader.run(command)) == expected)
    else:
        assert plain(reader.run(command)) == expected, command


def plain(text: str) -> str:
    """Return the text without times, numbers of cycles and qualities."""
    return re.sub(r"  cycle \d.*", "", re.sub(r"^\d\S+  ", "", text, flags=re.MULTILINE))
