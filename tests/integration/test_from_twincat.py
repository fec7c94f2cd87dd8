"""docs/from-twincat.md: a TwinCAT project becomes a plant whose stations exchange its data."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator

import pytest

from tests.support.pages import ROOT, Shell, commands, shell

pytestmark = pytest.mark.net

PAGE = (ROOT / "docs" / "from-twincat.md").read_text()
BLOCK = re.compile(r"```console\n(.*?)```", re.DOTALL)
SHOWN = 9
"""Commands with an output on the page."""


def outline(text: str) -> str:
    """Reduce an output to what is the same in every run."""
    text = re.sub(r"\d\d:\d\d:\d\d\.\d+", "CLOCK", text)
    text = re.sub(r"cycle \d+", "cycle N", text)
    text = re.sub(r"quality (\d+(\.\d+)? (µs|ms|s)|0)", "quality TIME", text)
    return "\n".join(line.rstrip() for line in text.splitlines())


@pytest.fixture
def reader() -> Iterator[Shell]:
    with shell(COLUMNS="100") as made:
        shutil.copy(ROOT / "docs" / "examples" / "Line.tsproj", made.folder)
        yield made


def test_page_leads_from_a_project_to_stations_that_exchange_its_data(reader: Shell) -> None:
    ran = 0
    for block in BLOCK.findall(PAGE):
        for command, expected in commands(block):
            assert outline(reader.run(command)) == outline(expected), command
            ran += 1
    assert ran >= SHOWN
    # All of it: each variable of both directions arrives.
    values = {
        "Line Speed": "1500", "Line Running": "true", "Line Recipe": "door", "Line Mode": "Manual",
        "panel Setpoint": "-2.5", "panel Start": "true",
    }  # fmt: skip
    for name, value in values.items():
        station, variable = name.split()
        receiver = "panel" if station == "Line" else "Line"
        # Subscribed to the change before it is made.
        reader.run(f"eapctl pd set {station} {variable} {value}")
        seen = ""
        for _ in range(200):
            seen = reader.run(f"eapctl pd watch {receiver} {variable} --count 1")
            if f"{receiver}/{variable} = {value}" in seen:
                break
        else:
            pytest.fail(f"{name}: {seen}")
    status = reader.run("eapctl status --json")
    assert '"discarded":{}' in status
    assert '"lost":0' in status
