from __future__ import annotations

from itertools import product

import pytest

from eap.errors import LocalProtocolError
from eap.pd.device import TRANSITIONS, Device, DeviceState, Request


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


@pytest.mark.parametrize(("state", "request_"), list(product(DeviceState, Request)))
def test_every_request_goes_where_the_table_says_or_names_what_was_possible(state, request_):
    device = Device()
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
