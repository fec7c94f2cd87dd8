"""A plant on two hosts: each starts its part, and a change of the file goes to both by ADS."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from eap.release import RELEASE
from tests.support.appliance import Appliance, Plants, plants, wait_until
from tests.support.namespaces import Namespace, cable

pytestmark = [pytest.mark.net, pytest.mark.root]

A, B = "10.88.164.1", "10.88.164.2"
RULE = "access: [{name: engineers, allow: [configure], from: [10.88.164.0/24]}]"
PLANT = f"""\
plant: halls
hosts:
  - {{name: cell-a, address: {A}, stations: [oven]}}
  - {{name: cell-b, address: {B}, stations: [panel]}}
stations:
  - name: oven
    net_id: {A}.1.1
    ports: [{{name: eap0, kind: eap, interface: "udp://{A}", net_id: {A}.2.1}}]
    variables: {{count: UDINT}}
    sources: {{count: {{kind: counter}}}}
    frames: [{{name: out, port: eap0, to: panel/eap0}}]
    publish: [{{name: state, frame: out, id: 1, variables: [count]}}]
    subscribe: [{{name: panel, port: eap0, from: panel/answer, timeout_ms: 5000}}]
    {RULE}
  - name: panel
    net_id: {B}.1.1
    ports: [{{name: eap0, kind: eap, interface: "udp://{B}", net_id: {B}.2.1}}]
    variables: {{level: UDINT}}
    sources: {{level: {{kind: counter}}}}
    frames: [{{name: back, port: eap0, to: oven/eap0}}]
    publish: [{{name: answer, frame: back, id: 2, variables: [level]}}]
    subscribe: [{{name: oven, port: eap0, from: oven/state, timeout_ms: 5000}}]
    {RULE}
"""
LONGER = PLANT.replace("{level: UDINT}", "{level: UDINT, mode: UINT}").replace(
    "variables: [level]", "variables: [level, mode]"
)
"""The PD of panel becomes longer, so that oven has to accept it before panel sends it."""


class Halls:
    """Two hosts that run their parts of the plant, with folders of their own."""

    def __init__(self, found: Plants, ends: tuple[Namespace, Namespace]) -> None:
        self.ends = ends
        self.folders = [found.folder / name for name in ("a", "b")]
        self.appliances: list[Appliance] = []
        for end, folder in zip(ends, self.folders, strict=True):
            folder.mkdir()
            plant = found.write(PLANT, f"{folder.name}/halls.yaml")
            found.state = folder / "state"
            self.appliances.append(found.run(plant, prefix=end.prefix))
        self.file = found.folder / "engineer.yaml"
        self._found = found

    def restart(self, number: int) -> None:
        """End the appliance of a host, and start it again."""
        self.appliances[number].stop()
        folder = self.folders[number]
        self._found.state = folder / "state"
        self.appliances[number] = self._found.run(
            folder / "halls.yaml", prefix=self.ends[number].prefix
        )

    def eapctl(self, *words: str, text: str = PLANT) -> tuple[int, str, str]:
        """Run a command about the plant *text* on host a; return exit code, stdout, stderr."""
        self.file.write_text(text)
        environment = {"EAP_RUNTIME_DIR": str(self.appliances[0].runtime), "PATH": "/usr/bin:/bin"}
        done = subprocess.run(
            [
                *self.ends[0].prefix,
                sys.executable,
                "-m",
                "eap",
                words[0],
                str(self.file),
                *words[1:],
            ],
            capture_output=True,
            text=True,
            check=False,
            env=environment,
            cwd=Path(__file__).parents[2],
        )
        return done.returncode, done.stdout, done.stderr

    def received(self, number: int) -> dict[str, Any]:
        """Return the counters of the one PD that a host receives."""
        (station,) = self.appliances[number].status()["stations"]
        (pd,) = station["pd"]["rx"]
        found: dict[str, Any] = pd
        return found


@pytest.fixture(scope="module")
def halls() -> Iterator[Halls]:
    with plants() as found, cable(addresses=True) as ends:
        made = Halls(found, ends)
        wait_until(lambda: all(made.received(each)["received"] > 10 for each in (0, 1)))
        yield made


def test_each_host_starts_its_stations_and_process_data_flows(halls: Halls) -> None:
    running = [[each["name"] for each in one.status()["stations"]] for one in halls.appliances]
    assert running == [["oven"], ["panel"]]
    assert halls.appliances[1].request("hello")["host"] == "cell-b"
    code, out, err = halls.eapctl("plan")
    assert (code, err) == (0, "")
    assert out == "no differences: all 2 stations are as the file says\n"


def test_change_goes_to_both_hosts_without_loss_and_back(halls: Halls) -> None:
    code, out, _ = halls.eapctl("plan", text=LONGER)
    assert code == 0, out
    assert "panel on cell-b\n" in out
    code, out, err = halls.eapctl("apply", text=LONGER)
    assert code == 0, (out, err)
    assert "oven on cell-a runs the new configuration; accepts old layouts too: ok" in out
    assert "panel on cell-b" in out
    wait_until(lambda: "panel.mode" in halls.appliances[0].values("oven"))
    code, out, _ = halls.eapctl("plan", text=LONGER)
    assert (code, out) == (0, "no differences: all 2 stations are as the file says\n")
    assert [halls.received(each)["lost"] for each in (0, 1)] == [0, 0]
    # The host's own plant file is the old one; a restart keeps what was applied.
    halls.restart(1)
    wait_until(lambda: halls.received(0)["state"] == "running")
    assert "mode" in halls.appliances[1].values("panel")
    code, out, err = halls.eapctl("rollback", text=LONGER)
    assert code == 0, (out, err)
    code, out, _ = halls.eapctl("plan")
    assert (code, out) == (0, "no differences: all 2 stations are as the file says\n")
    audit = (halls.folders[1] / "state/halls/audit.jsonl").read_text().splitlines()
    lines = [json.loads(line) for line in audit]
    asked = [line for line in lines if line.get("operation") in {"apply", "rollback"}]
    assert {line["from"] for line in asked} == {f"ams-tcp {A}, {A}.1.1"}
    assert {line["error"] for line in asked} == {""}


def test_host_without_a_rule_refuses_and_nothing_changes(halls: Halls) -> None:
    text = PLANT.replace(RULE, "access: []", 2)
    code, out, _ = halls.eapctl("apply", text=text)
    assert code == 0, out  # the rules themselves are what changes
    code, out, err = halls.eapctl("plan")
    assert code == 1
    assert err.startswith("host cell-b: ")
    assert "(access rules forbid it); the access rules of the station have to allow" in err
    halls.appliances[1].request("routing_rollback", station="panel")
    code, out, err = halls.eapctl("apply")
    assert code == 0, (out, err)


def test_change_that_one_host_cannot_keep_is_taken_back_on_all(halls: Halls) -> None:
    state = halls.folders[1] / "state"
    aside = state.with_name("aside")
    state.rename(aside)
    state.write_text("no folder")
    try:
        code, out, err = halls.eapctl("apply", text=LONGER)
    finally:
        state.unlink()
        aside.rename(state)
    assert code == 1, out
    assert "oven on cell-a runs the new configuration; accepts old layouts too: ok" in out
    assert "taken back: oven on cell-a" in out
    (refused,) = [line for line in out.splitlines() if line.endswith(": refused")]
    assert refused.startswith("panel on cell-b ")
    code, out, err = halls.eapctl("plan")
    assert (code, out) == (0, "no differences: all 2 stations are as the file says\n"), err


@pytest.mark.parametrize(
    ("release", "severity", "note"),
    [
        ("0.0.9", "warning", f"host cell-b runs release 0.0.9, this eapctl is {RELEASE}\n"),
        ("7.3.0", "error", ""),
    ],
)
def test_other_release_of_a_host_is_named_and_works_one_apart(
    halls: Halls,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    release: str,
    severity: str,
    note: str,
) -> None:
    script = f"import eap.release\neap.release.RELEASE = {release!r}\n"
    (tmp_path / "sitecustomize.py").write_text(script)
    with monkeypatch.context() as environment:
        environment.setenv("PYTHONPATH", str(tmp_path))
        halls.restart(1)
    wait_until(lambda: named(halls.appliances[1]))
    (finding,) = named(halls.appliances[1])
    assert finding["severity"] == severity
    assert finding["what"] == f"runs release {RELEASE}, this host {release}"
    code, out, err = halls.eapctl("plan")
    assert err == note
    if note:
        assert (code, out) == (0, "no differences: all 2 stations are as the file says\n")
    else:
        assert code == 1
        assert "host cell-b (panel): it runs release 7.3.0, this eapctl is " in out


def named(appliance: Appliance) -> list[dict[str, Any]]:
    """Return the findings about other hosts."""
    found = appliance.request("status")["findings"]
    return [each for each in found if each["where"].startswith("host ")]


def test_host_that_is_away_is_named_and_nothing_changes(halls: Halls) -> None:
    halls.appliances[1].stop()
    code, out, err = halls.eapctl("apply", text=LONGER)
    assert code == 1, (out, err)
    away = f"host cell-b (panel): {B} cannot be reached at port 48898: Connection refused"
    assert out == f"{away}\nno station changed\n"
    code, out, _ = halls.eapctl("plan", "--json", text=LONGER)
    (host,) = json.loads(out)["away"]
    assert (code, host["host"], host["stations"]) == (1, "cell-b", ["panel"])
    code, _, err = halls.eapctl("plan", "--station", "panel")
    assert (code, err) == (2, f"station panel is on host cell-b: {away.partition(': ')[2]}\n")
