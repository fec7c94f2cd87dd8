from __future__ import annotations

import pytest

from eap.control.bus import GatewayParameters
from eap.control.protocol import parameters
from eap.errors import ControlError


def test_a_station_without_a_port_stands_for_all_of_them():
    assert parameters({"station": "left"}, GatewayParameters).port == ""


def test_a_station_has_to_be_named():
    with pytest.raises(ControlError, match="station"):
        parameters({"port": "bus0"}, GatewayParameters)
