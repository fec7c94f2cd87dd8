from __future__ import annotations

from contextlib import ExitStack

import msgspec
import pytest

from eap.cli.pd_view import SkippedCycles, ValueChange, changes
from eap.errors import ControlError
from eap.ops.client import connect_station
from eap.pd.words import StationWord
from tests.support.records import record
from tests.unit.eap.cli.conftest import Appliance

pytestmark = pytest.mark.net


def test_stream_of_two_stations_brings_later_changes_of_both(appliance: Appliance) -> None:
    names = {"mixer": ["ticks"], "filler": ["ticks"]}
    with ExitStack() as stack:
        stream = changes(stack, names, period_ms=10, plant=None)
        assert {next(stream).station for _ in names} == set(names)
        for number, station in enumerate([*names] * 3, 1):
            appliance.set(station, "ticks", number)
            change = next(stream)
            assert (change.station, change.value) == (station, number)


def test_error_of_one_station_ends_the_stream(appliance: Appliance) -> None:
    names = {"mixer": ["ticks"], "filler": ["tocks"]}
    with ExitStack() as stack, pytest.raises(ControlError, match="did you mean ticks"):
        list(changes(stack, names, period_ms=10, plant=None))


def test_station_of_two_appliances_needs_a_plant(other_appliance: Appliance) -> None:
    with pytest.raises(ControlError, match="choose one with --plant"):
        connect_station("mixer", None)
    with connect_station("mixer", "hall") as client:
        assert client.info.plant == "hall"


def test_skipped_cycles_between_json_lines_are_reported_once_and_at_the_end() -> None:
    notes: list[str] = []
    skipped = SkippedCycles(100, notes.append)
    stream = [
        record(ValueChange, station="mixer", cycle=cycle, **more)
        for cycle, more in [
            (5, {}),
            (15, {"skipped": 9}),
            (15, {"skipped": 9}),
            (18, {"skipped": 2}),
        ]
    ]
    lines = [skipped.count(change) for change in stream]
    (note,) = notes
    assert note.startswith("mixer: 9 cycles before cycle 15 skipped: values are polled every 100")
    skipped.close()
    assert notes[1:] == ["mixer: 11 cycles skipped in all"]
    assert [line.cycle for line in lines] == [5, 15, 15, 18]
    assert all(b"skipped" not in msgspec.json.encode(line) for line in lines)


def test_change_after_skipped_cycles_has_their_number(appliance: Appliance) -> None:
    with ExitStack() as stack:
        stream = changes(stack, {"mixer": ["ticks"]}, period_ms=10, plant=None)
        assert not next(stream).skipped
        words = appliance.images["mixer"].image.words
        words[StationWord.FUTEX] = words[StationWord.CYCLE] = words[StationWord.CYCLE] + 10
        appliance.set("mixer", "ticks", 77)
        change = next(stream)
        assert (change.value, change.skipped) == (77, 9)
