from __future__ import annotations

import msgspec
import pytest

from eap.ams.spec import AccessRule, RoutingSpec
from eap.control.device import RoutingApplyParameters, RunningRouting
from eap.control.protocol import parameters
from eap.errors import ControlError


def test_a_routing_crosses_the_protocol():
    told = RoutingSpec(access=(AccessRule("a"),), learn=False)
    running = RunningRouting(routing=told, cause="1")
    assert msgspec.json.decode(msgspec.json.encode(running), type=RunningRouting) == running
    params = {"station": "left", "routing": msgspec.to_builtins(told)}
    assert parameters(params, RoutingApplyParameters).routing == told


def test_a_cause_is_short():
    with pytest.raises(ControlError, match="cause"):
        parameters({"station": "left", "routing": {}, "cause": "x" * 65}, RoutingApplyParameters)
