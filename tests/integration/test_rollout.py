"""Layouts change in a whole plant, station by station while all of it runs: nothing is lost."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from eap.device.rollout import steps
from eap.ids import InterfaceUri, NetId
from eap.net.loopback import LoopbackLines
from eap.pd.engine import Engine
from eap.pd.handover import ImageHandover
from eap.pd.report import station_status
from eap.pd.spec import (
    CounterSource,
    RxPdSpec,
    StationSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from eap.pd.station import Station
from tests.support.cyclic import MS, eap_port, image_of

NAMES = ("a", "b", "c", "d")
BEFORE = {"n": "UDINT", "on": "BOOL", "gone": "UINT"}
AFTER = {"added": "BIT3", "on": "BOOL", "level": "LREAL", "n": "UDINT"}


def net_id(name: str) -> str:
    return f"5.1.1.{NAMES.index(name)}.1.1"


def plant(
    layout: dict[str, str], version: int, heard: dict[str, str], renewed: Sequence[str] = NAMES
) -> dict[str, StationSpec]:
    """Each station sends a counter and more every millisecond, in *layout* if it is *renewed*.

    *heard* says whom each of them listens to.
    """
    layouts = {name: (layout, version) if name in renewed else (BEFORE, 1) for name in NAMES}
    return {name: _station(name, layouts, heard[name]) for name in NAMES}


def _station(name: str, layouts: dict[str, tuple[dict[str, str], int]], heard: str) -> StationSpec:
    layout, version = layouts[name]
    variables = [
        VariableSpec(each, kind, Writer.ENGINE if each == "n" else Writer.APPLICATION)
        for each, kind in layout.items()
    ]
    subscriptions = []
    for peer in heard:
        theirs, their_version = layouts[peer]
        names = tuple(f"{peer}.{each}" for each in theirs)
        variables += [
            VariableSpec(f"{peer}.{each}", kind, Writer.ENGINE) for each, kind in theirs.items()
        ]
        subscriptions.append(
            RxPdSpec(peer, "eap0", 7, names, net_id(peer), their_version, timeout_ms=5,
                     sender_cycle_us=1000, step=1)
        )  # fmt: skip
    frame = TxFrameSpec("f", "eap0", "x", (TxPdSpec("p", 7, tuple(layout), version),))
    return StationSpec(
        name, NetId.parse("5.9.9.9.1.1"), 1000, (eap_port(net_id=net_id(name)),),
        phase_us=200 * NAMES.index(name), variables=tuple(variables),
        sources=(CounterSource("n"),), frames=(frame,), subscriptions=tuple(subscriptions),
    )  # fmt: skip


class Line:
    """All stations of a plant on one line in memory."""

    def __init__(self, specs: dict[str, StationSpec]) -> None:
        lines = LoopbackLines()
        self.stations: dict[str, Station] = {}
        for name, spec in specs.items():
            channel = lines.open(InterfaceUri.parse("loop://line"))
            station = self.stations[name] = Station(spec, image_of(spec), lambda: None)
            channel.handlers.append(station.handlers["eap0"])
            station.connect("eap0", channel)
        self.engine = Engine(list(self.stations.values()))
        self.engine.start(0)
        self.now = 0

    def run(self, milliseconds: int) -> None:
        """Run for so long; whatever is received is never older than two cycles."""
        end = self.now + milliseconds * MS
        while (now := self.engine.next_timeout()) < end:
            self.now = now
            self.engine.handle_timeout(now)
            if self.now > 5 * MS:
                self.check_counters()

    def check_counters(self) -> None:
        for station in self.stations.values():
            for pd in station.spec.subscriptions:
                sent = self.stations[pd.name].image.read("n")
                assert 0 <= sent - station.image.read(f"{pd.name}.n") <= 1

    def configure(self, name: str, spec: StationSpec) -> None:
        """Let one station run *spec* from its next cycle on, as the engine does."""
        before = self.stations[name]
        image = image_of(spec)
        images = ImageHandover(before.image, image)
        images.carry_words()
        images.carry_values(before.inputs.memory)
        station = Station(spec, image, lambda: None)
        station.prepare_handover(before)
        images.commit()
        images.carry_words()
        images.carry_values(before.inputs.memory)
        station.follow(before, self.now)
        self.engine.replace(before, station, self.now)
        self.stations[name] = station


RING = {"a": "d", "b": "a", "c": "b", "d": "c"}
ALL = {name: NAMES[:at] + NAMES[at + 1 :] for at, name in enumerate(NAMES)}
STAR = {"a": "bcd", "b": "a", "c": "a", "d": "a"}


@pytest.mark.parametrize("heard", [RING, ALL, STAR], ids=["ring", "all", "star"])
@pytest.mark.parametrize("renewed", [NAMES, ("c",), ("a", "b")], ids=["all", "one", "two"])
@pytest.mark.parametrize("version", [1, 2])
def test_a_change_of_layouts_loses_nothing(heard, renewed, version):
    old, new = plant(BEFORE, 1, heard), plant(AFTER, version, heard, renewed)
    line = Line(old)
    line.run(20)
    for there, back in ((old, new), (new, old)):
        endpoint = steps(there, back)
        assert len(endpoint) >= len(renewed)
        for step in endpoint:
            line.configure(step.station, step.spec)
            line.run(7)
        assert {name: station.spec for name, station in line.stations.items()} == back
    for name, station in line.stations.items():
        status = station_status(station.image, line.now)
        assert status["discarded"].keys() <= {"wrong_publisher"}, "the line brings everything"
        for row in status["pd"]["rx"]:
            assert (row["lost"], row["duplicated"], row["reordered"], row["timeouts"]) == (0,) * 4
            sent = station_status(line.stations[row["name"]].image, line.now)["pd"]["tx"][0]["sent"]
            assert 0 <= sent - row["received"] <= 2, name
            assert row["state"] == "running"
