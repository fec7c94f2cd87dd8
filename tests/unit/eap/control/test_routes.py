from __future__ import annotations

import msgspec
import pytest

from eap.control.protocol import parameters
from eap.control.routes import (
    ROUTES_LIST,
    RoutesAddParameters,
    RoutesListParameters,
)
from eap.errors import ControlError
from tests.support.fakeroutes import FakeRoutes


def test_routes_records_round_trip_and_ignore_new_fields() -> None:
    told = msgspec.to_builtins(FakeRoutes().stations["island-01"])
    told["routes"][0]["colour"] = "new"
    assert ROUTES_LIST.decode([told]) == [FakeRoutes().stations["island-01"]]
    with pytest.raises(ControlError, match=r"answer to routes_list: Object missing required"):
        ROUTES_LIST.decode([{}])


@pytest.mark.parametrize(
    ("params", "text"),
    [
        ({"count": 1001}, "<= 1000"),
        ({"mach": "x"}, "unknown field `mach`"),
        ({"match": "x" * 256}, "length <= 255"),
    ],
)
def test_wrong_parameters_of_a_list_are_named(params: dict[str, object], text: str) -> None:
    with pytest.raises(ControlError, match=text):
        parameters(params, RoutesListParameters)


def test_octets_are_those_that_can_be() -> None:
    given = {"station": "a", "name": "b", "via": "udp:c", "octets": 3}
    with pytest.raises(ControlError, match="Invalid enum value 3"):
        parameters(given, RoutesAddParameters)
