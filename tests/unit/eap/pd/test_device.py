from __future__ import annotations

from itertools import product

import pytest

from eap.errors import LocalProtocolError
from eap.pd.device import (
    FAULT_TEXTS,
    TRANSITIONS,
    DeviceFault,
    DeviceState,
    EapDevice,
    FaultCode,
    StateRequest,
)


def test_preop_exchanges_nothing_safeop_sends_op_sends_and_receives():
    assert [(state.sends, state.receives) for state in DeviceState] == [
        (False, False),
        (False, False),
        (True, False),
        (True, True),
    ]


def test_states_are_numbered_as_the_al_status_is():
    assert {state.name: int(state) for state in DeviceState} == {
        "INIT": 1,
        "PREOP": 2,
        "SAFEOP": 4,
        "OP": 8,
    }


@pytest.mark.parametrize(("state", "request_"), list(product(DeviceState, StateRequest)))
def test_device_request_follows_table_or_names_possible_states(state, request_):
    device = EapDevice()
    device.state = state
    if (state, request_) in TRANSITIONS:
        assert device.request(request_) is TRANSITIONS[state, request_]
        return
    with pytest.raises(LocalProtocolError, match=rf"{request_.name} cannot .* {state.name}, only"):
        device.request(request_)
    assert device.state is state


def test_init_is_left_for_good_and_op_is_reached_through_safeop_only():
    assert DeviceState.INIT not in TRANSITIONS.values()
    into_op = {state for (state, _), target in TRANSITIONS.items() if target is DeviceState.OP}
    assert into_op == {DeviceState.SAFEOP, DeviceState.OP}


def test_every_code_has_a_text_of_its_own():
    assert set(FAULT_TEXTS) == set(FaultCode)
    assert len(set(FAULT_TEXTS.values())) == len(FaultCode)


def test_codes_leave_room_for_those_of_the_standard():
    assert all(code < 0x20 or code >= 0x8000 for code in FaultCode)


def test_device_fault_text_has_object_reason_and_detail():
    fault = DeviceFault(FaultCode.CYCLE_TIME, "1500 us", 0xD001, 7, "eap0")
    assert fault.text == str(fault)
    assert fault.text == "0xD001:07: cycle time does not fit the device cycle: 1500 us"
    assert (fault.code, fault.index, fault.subindex, fault.port) == (0x800D, 0xD001, 7, "eap0")
    assert DeviceFault(FaultCode.NO_MAILBOX).text == "mailbox is not set up"
