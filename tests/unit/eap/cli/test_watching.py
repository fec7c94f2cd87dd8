from __future__ import annotations

from contextlib import ExitStack

import pytest

from eap.appliance.commands.client import connect_station
from eap.cli.watching import changes
from eap.errors import ControlError
from tests.unit.eap.cli.conftest import Appliance

pytestmark = pytest.mark.net


def test_stream_of_two_stations_brings_later_changes_of_both(appliance: Appliance) -> None:
    names = {"mixer": ["ticks"], "filler": ["ticks"]}
    with ExitStack() as stack:
        stream = changes(stack, names, period_ms=10, plant=None)
        assert {next(stream)["station"] for _ in names} == set(names)
        for number, station in enumerate([*names] * 3, 1):
            appliance.set(station, "ticks", number)
            change = next(stream)
            assert (change["station"], change["value"]) == (station, number)


def test_error_of_one_station_ends_the_stream(appliance: Appliance) -> None:
    names = {"mixer": ["ticks"], "filler": ["tocks"]}
    with ExitStack() as stack, pytest.raises(ControlError, match="did you mean ticks"):
        list(changes(stack, names, period_ms=10, plant=None))


def test_station_of_two_appliances_needs_a_plant(other_appliance: Appliance) -> None:
    with pytest.raises(ControlError, match="choose one with --plant"):
        connect_station("mixer", None)
    with connect_station("mixer", "hall") as client:
        assert client.info.plant == "hall"
