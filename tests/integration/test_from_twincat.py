"""docs/from-twincat.md: a TwinCAT project becomes a plant whose stations exchange its data."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from eap.config.imports.treeitems import tree_items_text
from eap.ops.imports import ImportChoices, run_import
from eap.ops.peers import peer_report
from tests.support.appliance import Plants, wait_until
from tests.support.namespaces import cable
from tests.support.pages import ROOT, Shell, commands, shell

pytestmark = pytest.mark.net

LINE = ROOT / "docs" / "examples" / "Line.tsproj"

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
        shutil.copy(LINE, made.folder)
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


@pytest.mark.root
def test_imported_controller_and_its_peer_exchange_data_by_ethernet(
    farm: Plants, tmp_path: Path
) -> None:
    plant = tmp_path / "line.yaml"
    choices = ImportChoices(address="ethernet://line0", peer="panel")
    assert run_import([LINE], plant, choices)[0].ok
    with cable() as ends:
        # The adapter of the project: panel takes its frames from that address only.
        ends[0].unplug()
        ends[0].ip("link", "set", "line0", "address", "02:00:00:00:05:01")
        ends[0].plug()
        line, panel = (
            farm.start(plant, "--station", name, prefix=end.prefix)
            for name, end in zip(("Line", "panel"), ends, strict=True)
        )
        assert (line.wait_ready(), panel.wait_ready()) == (["Line"], ["panel"])
        line.command("pd", "set", "Line", "Axis", "{nState: 7, bEnabled: true, fPosition: 1.5}")
        panel.command("pd", "set", "panel", "Order", "door 7")
        wait_until(lambda: panel.values("panel")["Axis"]["fPosition"] == 1.5)
        wait_until(lambda: line.values("Line")["Order"] == "door 7")
        for side, count in ((line, 4), (panel, 5)):
            rows = side.status()["stations"][0]["pd"]["rx"]
            assert [row["state"] for row in rows] == ["running"] * count
            assert all(set(row["discarded"]) <= {"stale"} for row in rows)


def test_controller_made_of_the_exported_xml_exchanges_data_with_the_station(
    farm: Plants, tmp_path: Path
) -> None:
    plant, xml, tmc, other = (
        tmp_path / name for name in ("line.yaml", "Peer.xml", "types.tmc", "peer.yaml")
    )
    run_import([LINE], plant, ImportChoices(address="127.0.5.{n}", peer="panel"))
    xml.write_text(tree_items_text(peer_report(plant, "panel")[0]))
    project = LINE.read_text()
    types = project[project.index("<DataTypes>") : project.index("<Project ")]
    tmc.write_text(f"<TcModuleClass>{types}</TcModuleClass>")
    result, _ = run_import([xml, tmc], other, ImportChoices(address="127.0.5.1"))
    assert (result.ok, result.stations) == (True, ("Peer",))
    panel, controller = farm.start(plant, "--station", "panel"), farm.start(other)
    assert (panel.wait_ready(), controller.wait_ready()) == (["panel"], ["Peer"])
    controller.command("pd", "set", "Peer", "Mode", "Automatic")
    panel.command("pd", "set", "panel", "Target", "{nState: 7, bEnabled: true, fPosition: 1.5}")
    wait_until(lambda: panel.values("panel")["Mode"] == "Automatic")
    wait_until(lambda: controller.values("Peer")["Target"]["fPosition"] == 1.5)
