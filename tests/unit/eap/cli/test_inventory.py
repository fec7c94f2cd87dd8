from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from eap.cli.group import main

PLANT = """\
plant: hall-2
hosts:
  - {name: cell-a, address: 10.0.0.1, stations: [oven]}
  - {name: cell-b, address: 10.0.0.2, user: eap, stations: [panel]}
stations:
  - name: oven
    net_id: 10.0.0.1.1.1
    ports: [{name: eap0, kind: eap, interface: "udp://10.0.0.1", net_id: 10.0.0.1.2.1}]
  - name: panel
    net_id: 10.0.0.2.1.1
    ports: [{name: eap0, kind: eap, interface: "udp://10.0.0.2", net_id: 10.0.0.2.2.1}]
"""
OVEN = {"ansible_host": "10.0.0.1", "eap_host": "cell-a", "eap_stations": ["oven"]}
PANEL = {
    "ansible_host": "10.0.0.2",
    "ansible_user": "eap",
    "eap_host": "cell-b",
    "eap_stations": ["panel"],
}


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    path = tmp_path / "hall.yaml"
    path.write_text(PLANT)
    return path


@pytest.mark.parametrize("options", [[], ["--list"], ["--list", "--json"]])
def test_inventory_lists_groups_and_all_variables(plant: Path, options: list[str]) -> None:
    result = CliRunner().invoke(main, ["inventory", str(plant), *options])
    assert result.exit_code == 0
    assert json.loads(result.stdout) == {
        "_meta": {"hostvars": {"cell-a": OVEN, "cell-b": PANEL}},
        "all": {"children": ["eap"]},
        "eap": {"children": ["eap_hall_2"]},
        "eap_hall_2": {
            "hosts": ["cell-a", "cell-b"],
            "vars": {"eap_plant": "hall-2", "eap_plant_file": str(plant)},
        },
    }


def test_inventory_of_one_host_has_its_variables(plant: Path) -> None:
    result = CliRunner().invoke(main, ["inventory", str(plant), "--host", "cell-b"])
    assert json.loads(result.stdout) == PANEL


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--host", "cell-c"], "plant hall-2 has no host 'cell-c', did you mean cell-b?\n"),
        (["--host", "cell-a", "--list"], "--list and --host NAME exclude each other"),
    ],
)
def test_inventory_of_no_host_is_an_error(plant: Path, options: list[str], reason: str) -> None:
    result = CliRunner().invoke(main, ["inventory", str(plant), *options])
    assert (result.exit_code, result.stdout) == (2, "")
    assert reason in result.stderr


def test_inventory_of_a_plant_without_hosts_is_an_error(plant: Path) -> None:
    lines = PLANT.splitlines(keepends=True)
    without = [line for line in lines if "address:" not in line and "hosts" not in line]
    plant.write_text("".join(without))
    result = CliRunner().invoke(main, ["inventory", str(plant)])
    assert (result.exit_code, result.stdout) == (2, "")
    reason = "plant hall-2 has no hosts: name them with their stations in hosts: of its file\n"
    assert result.stderr == reason


@pytest.mark.net
@pytest.mark.parametrize(
    ("options", "environment", "reason"),
    [
        ([], {}, " is none of its hosts, cell-a at 10.0.0.1, cell-b at 10.0.0.2; choose one with"),
        (["--host", "cell-c"], {}, "plant hall-2 has no host 'cell-c', did you mean cell-b?"),
        ([], {"EAP_HOST": "cell-c"}, "plant hall-2 has no host 'cell-c', did you mean cell-b?"),
        (
            ["--host", "cell-a", "--station", "panel"],
            {},
            "station panel runs on host cell-b, this is host cell-a",
        ),
        # The stations of the named host are tried: this computer does not have their address.
        (["--host", "cell-b"], {}, "10.0.0.2 is not an address of this machine: "),
        (["--station", "oven"], {}, "10.0.0.1 is not an address of this machine: "),
    ],
)
def test_run_starts_the_stations_of_one_host(
    plant: Path,
    runtime: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: list[str],
    environment: dict[str, str],
    reason: str,
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    result = CliRunner().invoke(main, ["run", str(plant), *options])
    assert result.exit_code == 2
    assert reason in result.stderr


def test_example_of_the_page_is_right(tmp_path: Path) -> None:
    page = (Path(__file__).parents[4] / "docs/commands.md").read_text()
    example = page[page.index("$ eapctl inventory line.yaml\n") :].splitlines()[1]
    path = tmp_path / "line.yaml"
    text = PLANT.replace("hall-2", "line").replace("10.0.0.1", "10.0.0.11")
    before, _, rest = text.partition("  - {name: cell-b")
    stations = rest.partition("\n")[2].partition("  - name: panel")[0]
    path.write_text(before + stations)
    result = CliRunner().invoke(main, ["inventory", str(path)])
    assert result.stdout == example.replace("/etc/eap/line.yaml", str(path)) + "\n"
