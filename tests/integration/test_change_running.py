"""Stations that are changed while programs, buses and other stations use them."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec
import pytest
from msgspec.structs import replace

import eap
from eap.errors import EapError
from eap.ids import InterfaceUri, decode_value, encode_value
from eap.pd.spec import LengthCheck, StationSpec, TxFrameSpec, TxPdSpec, VariableSpec, Wake
from eap.runtime.folder import VARIABLE
from tests.support.addresses import own_address
from tests.support.appliance import Appliance, Plants, troubles, wait_until

pytestmark = pytest.mark.net

BUSES = Path(__file__).parents[2] / "config" / "buses"
CHANGES = 8
HERE, THERE = own_address(0), own_address(1)
NOT_OF_THIS_HOST = "192.0.2.1"
PLANT = f"""
plant: change
defaults: {{cycle_us: 5000}}
stations:
  - name: left
    net_id: 10.9.7.1.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{HERE}", net_id: 10.9.7.1.2.1}}
      - {{name: bus0, kind: bus, interface: "sim://{BUSES}/buttons.yaml", net_id: 10.9.7.1.3.1}}
    variables:
      setpoint: {{type: UDINT, default: 0}}
      beat: {{type: UINT}}
    sources:
      beat: {{kind: counter}}
    frames:
      - {{name: to-right, port: eap0, to: right/eap0}}
    publish:
      - {{name: state, frame: to-right, id: 1, version: 1, variables: [beat, setpoint]}}
    subscribe:
      - {{port: eap0, name: answer, from: right/answer, variables: {{heard: UDINT}}}}
    links:
      - {{from: heard, bits: 1, to: bus0.buttons.lamp}}
  - name: right
    net_id: 10.9.7.2.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{THERE}", net_id: 10.9.7.2.2.1}}
    frames:
      - {{name: to-left, port: eap0, to: left/eap0}}
    publish:
      - {{name: answer, frame: to-left, id: 1, version: 1, variables: [setpoint]}}
    subscribe:
      - port: eap0
        name: state
        from: left/state
        variables: {{beat: UINT, setpoint: UDINT}}
"""


@pytest.fixture
def plant(farm: Plants) -> Iterator[Appliance]:
    appliance = farm.run(farm.write(PLANT))
    with mock.patch.dict(os.environ, {VARIABLE: str(appliance.runtime)}):
        wait_until(lambda: appliance.values("left")["bus0.state"] == 8)
        yield appliance


def spec_of(plant: Appliance, station: str) -> StationSpec:
    return msgspec.convert(
        plant.request("export", station=station)["spec"], StationSpec, dec_hook=decode_value
    )


def apply(plant: Appliance, spec: StationSpec) -> dict[str, Any]:
    document = msgspec.to_builtins(spec, enc_hook=encode_value)
    answer: dict[str, Any] = plant.request("apply", station=spec.name, spec=document)
    return answer


def with_more(spec: StationSpec, number: int) -> StationSpec:
    """Return *spec* with another variable in front, and a PD of its own for it."""
    name = f"more-{number}"
    frame = TxFrameSpec(name, "eap0", THERE, (TxPdSpec(name, 100 + number, (name,)),))
    variables = (VariableSpec(name, "INT", default=number), *spec.variables)
    return replace(spec, variables=variables, frames=(*spec.frames, frame))


class Program(threading.Thread):
    """Writes and waits in each cycle until told to stop, and notes what goes wrong."""

    def __init__(self) -> None:
        super().__init__()
        self.written = 0
        self.wrong: list[str] = []
        self._ending = threading.Event()
        self.start()

    def run(self) -> None:
        try:
            with eap.attach("left") as station:
                before = station.wait_cycle()
                while not self._ending.is_set():
                    self.written += 1
                    station["setpoint"] = self.written
                    cycle = station.wait_cycle()
                    if cycle <= before or station["setpoint"] != self.written:
                        self.wrong.append(f"{before} -> {cycle}: {station['setpoint']}")
                    before = cycle
        except (EapError, KeyError) as exc:
            self.wrong.append(repr(exc))

    def end(self) -> None:
        self._ending.set()
        self.join()


def bus_of(plant: Appliance) -> tuple[int, int, int]:
    """Return the cycles of the bus, and those that went wrong."""
    report = plant.request("bus_describe", station="left", port="bus0")
    return report["cycles"], report["cycles_lost"], report["wkc_errors"]


def test_programs_buses_and_other_stations_notice_nothing(plant: Appliance) -> None:
    spec = spec_of(plant, "left")
    before = plant.rx("right", "state"), plant.rx("left", "answer")
    cycles, *faults = bus_of(plant)
    program = Program()
    wait_until(lambda: program.written > 5)
    for number in range(CHANGES):
        assert apply(plant, with_more(spec, number))["ok"]
        written = program.written
        wait_until(lambda: program.written > written + 5)  # noqa: B023  called at once
        wait_until(lambda: plant.values("right")["setpoint"] > written)  # noqa: B023
    program.end()
    assert program.wrong == []
    wait_until(lambda: plant.values("left")["heard"] == program.written)
    after = plant.rx("right", "state"), plant.rx("left", "answer")
    assert [troubles(rx) for rx in after] == [troubles(rx) for rx in before]
    later, *faults_later = bus_of(plant)
    assert faults_later == faults
    assert later > cycles
    status = plant.station("left")
    assert (status["state"], status["restarts"]) == ("OP", 0)
    # A busy machine stops the program in the middle of writing, for some cycles; no change does.
    wait_until(lambda: plant.station("left")["cycle"] > status["cycle"] + 5)
    assert plant.station("left")["torn"] == status["torn"]
    assert [pd["name"] for pd in status["pd"]["tx"]] == ["state", f"more-{CHANGES - 1}"]
    sent = status["pd"]["tx"][0]["sent"]
    assert 0 <= status["cycle"] - sent <= 1


def test_an_engine_that_dies_right_after_a_change_runs_what_was_applied(plant: Appliance) -> None:
    spec = with_more(spec_of(plant, "left"), 1)
    sent = plant.tx("left", "state")["sent"]
    assert apply(plant, spec)["ok"]
    os.kill(plant.pid("engine"), signal.SIGKILL)
    wait_until(lambda: plant.station("left")["restarts"] == 1)
    assert plant.tx("left", "state")["sent"] > sent
    wait_until(lambda: plant.tx("left", "more-1")["sent"] > 2)
    assert plant.values("left")["more-1"] == 1
    assert spec_of(plant, "left") == spec


def test_impossible_plant_is_refused_and_the_old_keeps_running(plant: Appliance) -> None:
    spec = spec_of(plant, "left")
    before = plant.rx("right", "state")
    eap0, bus0 = spec.ports
    elsewhere = replace(eap0, interface=InterfaceUri.parse(f"udp://{NOT_OF_THIS_HOST}"))
    unknown = replace(spec.subscriptions[0], variables=("nothing",))
    for other, reason in (
        (replace(spec, ports=(elsewhere, bus0)), f"{NOT_OF_THIS_HOST} is not an address"),
        (replace(spec, subscriptions=(unknown,)), "refers to 'nothing'"),
    ):
        answer = apply(plant, other)
        assert not answer["ok"], answer
        assert reason in answer["refused"][0]
    assert spec_of(plant, "left") == spec
    received = before["received"]
    wait_until(lambda: plant.rx("right", "state")["received"] > received + 5)
    assert troubles(plant.rx("right", "state")) == troubles(before)


def test_settings_of_a_port_change_one_by_one_while_it_exchanges_data(plant: Appliance) -> None:
    spec = spec_of(plant, "left")
    eap0, bus0 = spec.ports
    engine = plant.pid("engine")
    for change in (
        {"join": ("239.1.2.3",)},
        {"broadcast": True},
        {"tcp": True},
        {"wake": Wake.ARRIVAL},
        {"eap_sm": True},
        {"length": LengthCheck.LENIENT},
        {"profile": 1},
        {"ams": False},
        {},
    ):
        answer = apply(plant, replace(spec, ports=(replace(eap0, **change), bus0)))
        assert answer["ok"], (change, answer)
        received = plant.rx("left", "answer")["received"]
        wait_until(lambda so_far=received: plant.rx("left", "answer")["received"] > so_far + 2)
    assert plant.pid("engine") == engine
    assert spec_of(plant, "left") == spec


def test_states_are_requested_of_a_running_bus(plant: Appliance) -> None:
    def go(state: str) -> None:
        assert plant.request("request_state", target="right", state=state)["state"] == state

    go("SAFEOP")
    discarded = plant.station("right")["discarded"].get("suppressed", 0)
    wait_until(lambda: plant.station("right")["discarded"]["suppressed"] > discarded + 3)
    sent = plant.tx("right", "answer")["sent"]
    wait_until(lambda: plant.tx("right", "answer")["sent"] > sent)
    go("PREOP")
    sent = plant.tx("right", "answer")["sent"]
    discarded = plant.station("right")["discarded"]["suppressed"]
    wait_until(lambda: plant.station("right")["discarded"]["suppressed"] > discarded + 3)
    assert plant.tx("right", "answer")["sent"] == sent
    go("SAFEOP")
    go("OP")
    received = plant.rx("right", "state")["received"]
    wait_until(lambda: plant.rx("right", "state")["received"] > received + 5)
    assert troubles(plant.rx("right", "state")) == (0, 0, 0)
    assert plant.tx("right", "answer")["sent"] > sent
