"""The examples of docs/s7.md and docs/modbus.md, run as a reader would."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.support.eventually import wait_until
from tests.support.pages import Shell, commands, shell

pytestmark = pytest.mark.net

DOCS = Path(__file__).parents[2] / "docs"


def fits(expected: str, output: str) -> bool:
    """Return whether *output* is that of the page, where ``…`` stands for anything."""
    pattern = ".*".join(re.escape(part) for part in " ".join(expected.split()).split("…"))
    return re.fullmatch(pattern, " ".join(output.split()), re.DOTALL) is not None


def run(found: Shell, command: str, expected: str) -> None:
    if command.endswith("&") or not expected.strip():
        found.run(command)
        return
    output = ""

    def is_shown() -> bool:
        nonlocal output
        output = found.run(command)
        return fits(expected, output)

    # A value, or a time-out, takes a moment: the reader would look again.
    try:
        wait_until(is_shown)
    except AssertionError:
        raise AssertionError(f"{command}: expected\n{expected}\nbut it shows\n{output}") from None


@pytest.mark.parametrize("name", ["s7", "modbus"])
def test_page_does_what_it_shows(name: str) -> None:
    page = (DOCS / f"{name}.md").read_text()
    blocks = dict(re.findall(r"```yaml\n# (\S+)\n(.*?)```", page, re.DOTALL))
    consoles = re.findall(r"```console\n(.*?)```", page, re.DOTALL)
    assert (len(blocks), len(consoles)) == (2, 2 if name == "s7" else 1)
    with shell() as found:
        for file, text in blocks.items():
            (found.folder / file).write_text(text)
        for number, console in enumerate(consoles):
            if number:
                found.end_first()
            for command, expected in commands(console):
                run(found, command, expected)
