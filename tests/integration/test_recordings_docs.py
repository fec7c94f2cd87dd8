"""docs/recordings.md: its walk with the demo works, and so does its program."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator

import pytest

from tests.support.appliance import wait_until
from tests.support.pages import ROOT, Shell, commands, shell

pytestmark = pytest.mark.net

PAGE = (ROOT / "docs" / "recordings.md").read_text()
WALK = PAGE.partition("## A walk with the demo")[2].partition("## Recording\n")[0]
PROGRAM = re.search(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture
def reader() -> Iterator[Shell]:
    with shell() as made:
        (made.folder / "config").symlink_to(ROOT / "config")
        yield made


def messages(reader: Shell) -> list[int]:
    lines = reader.run("eapctl record list --json").splitlines()
    return [json.loads(line)["messages"] for line in lines]


def test_walk_of_the_page_works_with_the_demo(reader: Shell) -> None:
    printed = {}
    for command, _ in commands(WALK.partition("```console\n")[2].partition("```")[0]):
        if "record mark" in command:
            wait_until(lambda: all(number > 300 for number in messages(reader)))
        printed[command] = reader.run(command)
    text = "\n".join(printed.values())
    assert "Usage" not in text
    assert "demo.csv" in text
    assert "door open" in printed["eapctl record info demo.mcap"]
    assert "none lost" in printed["eapctl record info demo.mcap"]
    assert (reader.folder / "demo.csv").read_text().startswith("time_ns,island-01/")
    assert "island-01/cpu" in printed["eapctl plot demo.mcap island-01/cpu"]
    assert "<svg" in (reader.folder / "ticks.html").read_text()
    assert "island-03/eap0" in printed["eapctl replay wire.pcapng --dry-run"]
    assert PROGRAM is not None
    (reader.folder / "program.py").write_text(PROGRAM[1])
    assert reader.run(f"{sys.executable} program.py") == ""


def test_commands_of_the_page_are_those_of_the_program(reader: Shell) -> None:
    for command in sorted(set(re.findall(r"^\$ eapctl ((?:record )?[a-z]+)", PAGE, re.MULTILINE))):
        assert reader.run(f"eapctl {command} --help").startswith("Usage"), command
