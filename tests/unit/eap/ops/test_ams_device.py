from __future__ import annotations

from contextlib import ExitStack

import pytest

from eap.ads.request import ReadState
from eap.errors import ControlError
from eap.ops.routing import AmsRefusedError, open_ams
from tests.support.adstarget import TARGET, AdsTarget
from tests.support.oddevice import mixer


@pytest.fixture
def target(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path))
    with ExitStack() as stack:
        yield AdsTarget(mixer(), stack)


def test_ams_device_sends_requests_through_an_appliance(target):
    with open_ams(TARGET, None) as device:
        assert device.demand(ReadState(), "state")[2] == 2
    assert target.stub.requests[-1][1]["target"] == TARGET


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (0x1B, r"state: error 0x1b \(host unreachable\); 'eapctl trace far/bus0/1001' shows where"),
        (0x704, r"state: it may not be read or written so \(error 0x704\)$"),
        (0x723, r"state: error 0x723 \(access rules forbid it\); 'eapctl trace"),
    ],
)
def test_refusals_have_a_remedy(target, error, text):
    target.error = error
    with open_ams(TARGET, None) as device, pytest.raises(AmsRefusedError, match=text) as caught:
        device.demand(ReadState(), "state")
    assert caught.value.result == error


def test_trace_of_an_unknown_target_fails(target):
    with (
        pytest.raises(ControlError, match="no such station in this plant"),
        open_ams("elsewhere", None),
    ):
        pass


def test_ams_device_unreachable_names_the_router_that_does_not_answer(target):
    target.error = 0x1B
    target.why = "near: middle (10.0.0.2:34980 by udp:eap0) is down: it does not answer"
    with open_ams(TARGET, None) as device, pytest.raises(AmsRefusedError) as caught:
        device.demand(ReadState(), "state")
    assert str(caught.value) == f"{TARGET}: state: {target.why}"
    assert target.stub.requests[-1] == ("trace", {"target": TARGET})
