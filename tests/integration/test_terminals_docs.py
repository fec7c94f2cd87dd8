"""docs/terminals-and-drives.md: from the ESI files of a vendor to a running plant."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator

import pytest

from tests.support.appliance import wait_until
from tests.support.pages import ROOT, Shell, commands, shell

pytestmark = pytest.mark.net

PAGE, _, ENI = (
    (ROOT / "docs" / "terminals-and-drives.md").read_text().partition("## From an ENI file")
)
BLOCK = re.compile(r"```(yaml|console)\n(.*?)```", re.DOTALL)
ARRIVES = ("bus state", "pd watch")
"""Commands whose answer takes a moment to be the shown one."""


@pytest.fixture
def reader() -> Iterator[Shell]:
    with shell(COLUMNS="100") as made:
        shutil.copytree(ROOT / "config" / "esi", made.folder / "esi")
        shutil.copy(ROOT / "docs" / "examples" / "Cell.xml", made.folder)
        yield made


# The second part is a plant of its own, made of an ENI file.
@pytest.mark.parametrize("part", [PAGE, ENI], ids=["esi", "eni"])
def test_terminals_page_commands_print_the_shown_output(reader: Shell, part: str) -> None:
    for kind, text in BLOCK.findall(part):
        if kind == "yaml":
            name = text.partition("\n")[0].removeprefix("# ")
            (reader.folder / name).write_text(text)
            continue
        for command, expected in commands(text):
            check(reader, command, expected)


def check(reader: Shell, command: str, expected: str) -> None:
    """Run *command* and compare; values of slaves take a moment to be there."""
    if any(each in command for each in ARRIVES):
        wait_until(lambda: plain(reader.run(command)) == plain(expected))
    else:
        assert plain(reader.run(command)) == plain(expected), command


def plain(text: str) -> str:
    """Return the text without times, numbers of cycles and trailing spaces."""
    text = re.sub(r"^\d\d:\S+  |  cycle \d+(  quality .*)?$", "", text, flags=re.MULTILINE)
    lines = text.splitlines()
    return "\n".join(line.rstrip() for line in lines).strip()
