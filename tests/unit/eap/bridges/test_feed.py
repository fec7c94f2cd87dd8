"""The feed of a bridge on a stub plant."""

from __future__ import annotations

import asyncio

from eap.bridges.feed import BridgeFeed
from eap.bridges.values import Quality, Sample, select
from eap.control.protocol import ErrorCode, ValuesEvent, VariableRow
from eap.errors import ControlError
from eap.live.client import LiveClient
from tests.support.virtualtime import run_virtual

AXIS = "Axis<8/4:pos@0 REAL,speed@4 REAL>"
ROWS = [
    VariableRow("speed", "REAL", "engine", "1/min", "of the drum"),
    VariableRow("setpoint", "UINT", "application", "", ""),
    VariableRow("axis", AXIS, "engine", "mm", ""),
]
AT_NS = 1_700_000_000_000_000_000


class StubStation:
    """Connection to an appliance with one station ``mixer`` (PlantConnection)."""

    def __init__(self) -> None:
        self.rows = list(ROWS)
        self.events: asyncio.Queue[ValuesEvent | ControlError] = asyncio.Queue()
        self.watched: list[tuple[str, ...]] = []
        self.answers = True

    async def request(self, method, params):
        if not self.answers:
            raise ControlError("gone", code=ErrorCode.UNAVAILABLE)
        if method == "hello":
            return {"version": 1, "plant": "line", "stations": ["mixer"]}
        assert method == "variables"
        return [{"name": r.name, "type": r.type, "writer": r.writer, "unit": r.unit,
                 "comment": r.comment} for r in self.rows]  # fmt: skip

    async def watch(self, wanted):
        if not self.answers:
            raise ControlError("gone", code=ErrorCode.UNAVAILABLE)
        self.watched.append(wanted.names)
        while True:
            yield await self.events.get()

    async def close(self) -> None:
        pass


def event(values, cycle=1, at_ns=AT_NS, **more) -> ValuesEvent:
    return ValuesEvent("mixer", cycle, values, **{"quality": {}, "time_ns": at_ns} | more)


class Scene:
    """A feed of a stub plant, and the changes that it reported."""

    def __init__(self, *patterns: str) -> None:
        self.station = StubStation()
        self.changes: list[dict[str, Sample]] = []
        self.directories: list[list[str]] = []

        async def connect():
            return self.station

        self.now_ns = AT_NS
        self.feed = BridgeFeed(
            lambda: LiveClient(connect), patterns, 100,
            on_variables=lambda: self.directories.append(list(self.feed.variables)),
            on_values=lambda found: self.changes.append(dict(found)),
            now=lambda: self.now_ns,
        )  # fmt: skip

    async def play(self, *events: ValuesEvent | ControlError, until_s: float = 1.0) -> None:
        """Run the feed for a while after *events* came."""
        for each in events:
            self.station.events.put_nowait(each)
            await asyncio.sleep(0.01)
        await asyncio.sleep(until_s)


def play(scene: Scene, script) -> None:
    async def run() -> None:
        async with asyncio.TaskGroup() as group:
            task = group.create_task(scene.feed.run())
            await asyncio.sleep(0.1)
            await script()
            task.cancel()

    run_virtual(run())


def test_select_takes_patterns_members_and_no_other_station():
    chosen = select(ROWS, "mixer", ["mixer/s*", "mixer/axis.pos", "mill/*", "mixer/axis.none"])
    assert [each.name for each in chosen] == ["mixer/speed", "mixer/setpoint", "mixer/axis.pos"]
    speed, setpoint, position = chosen
    assert (speed.unit, speed.comment, speed.is_settable) == ("1/min", "of the drum", False)
    assert setpoint.is_settable
    assert (position.type, position.unit) == ("REAL", "mm")


def test_feed_reports_only_changes_of_value_and_quality():
    scene = Scene("*/s*")

    async def script() -> None:
        await scene.play(
            event({"speed": 1.5, "setpoint": 4}, quality={"speed": 20}),
            event({"speed": 1.5, "setpoint": 4}, quality={"speed": 30}, cycle=2),
            event({"speed": 1.5, "setpoint": 5}, quality={"speed": 40}, cycle=3, stale=("speed",)),
        )

    play(scene, script)
    assert scene.directories == [["mixer/speed", "mixer/setpoint"]]
    assert scene.station.watched == [("speed", "setpoint")]
    assert scene.changes == [
        {
            "mixer/speed": Sample(1.5, Quality.GOOD, AT_NS - 2_000_000),
            "mixer/setpoint": Sample(4, Quality.GOOD, AT_NS),
        },
        {
            "mixer/speed": Sample(1.5, Quality.STALE, AT_NS - 4_000_000),
            "mixer/setpoint": Sample(5, Quality.GOOD, AT_NS),
        },
    ]


def test_feed_reports_value_that_was_set_back_after_a_write():
    scene = Scene("mixer/setpoint", "mixer/axis")
    values = {"setpoint": 4, "axis": {"pos": 1.0, "speed": 0.0}}

    async def script() -> None:
        await scene.play(event(values))
        scene.feed.report_again("mixer/setpoint")
        scene.feed.report_again("mixer/axis.pos")
        await scene.play(event(values, cycle=2), event(values, cycle=3))

    play(scene, script)
    assert [list(each) for each in scene.changes] == 2 * [["mixer/setpoint", "mixer/axis"]]


def test_feed_value_never_received_is_bad():
    scene = Scene("mixer/speed")

    async def script() -> None:
        await scene.play(event({"speed": 0.0}, quality={"speed": None}))

    play(scene, script)
    assert scene.changes == [{"mixer/speed": Sample(0.0, Quality.BAD, AT_NS)}]


def test_feed_station_without_cycles_is_stale():
    scene = Scene("mixer/speed")

    async def script() -> None:
        await scene.play(event({"speed": 1.0}))
        scene.now_ns += 3_000_000_000
        await scene.play(event({"speed": 1.0}))

    play(scene, script)
    assert [each["mixer/speed"].quality for each in scene.changes] == [Quality.GOOD, Quality.STALE]


def test_feed_of_lost_appliance_is_stale_and_recovers():
    scene = Scene("mixer/speed")

    async def script() -> None:
        await scene.play(event({"speed": 1.0}))
        await scene.play(ControlError("gone", code=ErrorCode.UNAVAILABLE))
        await scene.play(event({"speed": 1.0}))

    play(scene, script)
    qualities = [each["mixer/speed"].quality for each in scene.changes]
    assert qualities == [Quality.GOOD, Quality.STALE, Quality.GOOD]


def test_feed_waits_for_appliance_that_does_not_answer():
    scene = Scene("mixer/speed")
    scene.station.answers = False

    async def script() -> None:
        await asyncio.sleep(5)
        assert not scene.feed.variables
        scene.station.answers = True
        await scene.play(event({"speed": 1.0}), until_s=5)

    play(scene, script)
    assert list(scene.feed.samples) == ["mixer/speed"]


def test_feed_follows_station_that_is_configured_anew():
    scene = Scene("mixer/s*")

    async def script() -> None:
        await scene.play(event({"speed": 1.0, "setpoint": 2}))
        scene.station.rows = [ROWS[1], VariableRow("state", "BYTE", "engine", "", "")]
        await scene.play(ControlError("no 'speed'", code=ErrorCode.UNKNOWN_NAME))
        await scene.play(event({"setpoint": 3, "state": 8}))

    play(scene, script)
    assert scene.directories[-1] == ["mixer/setpoint", "mixer/state"]
    assert scene.station.watched == [("speed", "setpoint"), ("setpoint", "state")]
    assert scene.feed.samples.keys() == {"mixer/setpoint", "mixer/state"}
