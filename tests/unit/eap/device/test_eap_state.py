from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.device.eap_read import read_back
from eap.device.eap_state import EapStateMachine
from eap.device.fault import DeviceFault, FaultCode
from eap.od.model import OdState
from eap.pd.device import DeviceState
from eap.pd.spec import StationSpec
from tests.support.downloads import PREOP, sender, write
from tests.support.stations import BLANK, empty

INIT, PRE, SAFE, OPER = DeviceState.INIT, DeviceState.PREOP, DeviceState.SAFEOP, DeviceState.OP


class Actions:
    """Notes what transitions do; refuses what it is told to."""

    def __init__(self) -> None:
        self.done: list[str] = []
        self.refuse: str = ""
        self.spec: StationSpec | None = None

    def _do(self, what: str) -> None:
        if what == self.refuse:
            raise DeviceFault(FaultCode.NOT_RUNNING, what)
        self.done.append(what)

    def start_sending(self, spec: StationSpec) -> None:
        self._do("start sending")
        self.spec = spec

    def start_receiving(self) -> None:
        self._do("start receiving")

    def stop_receiving(self) -> None:
        self._do("stop receiving")

    def stop_sending(self) -> None:
        self._do("stop sending")


@pytest.fixture
def actions() -> Actions:
    return Actions()


@pytest.fixture
def machine(actions: Actions) -> EapStateMachine:
    machine = EapStateMachine(lambda: BLANK, actions)
    machine.start()
    return machine


def test_init_is_left_when_there_is_a_mailbox(actions):
    machine = EapStateMachine(lambda: BLANK, actions)
    assert machine.status == (INIT, None)
    assert machine.od_state is None
    result = machine.start(has_mailbox=False)
    assert result.state is INIT
    assert result.fault is not None
    assert result.fault.code == FaultCode.NO_MAILBOX
    assert result.word == 0x11
    assert machine.start().word == 2
    assert machine.od_state is OdState.PREOP
    assert machine.start() == (PRE, None)


@pytest.mark.parametrize(
    ("before", "wanted", "done"),
    [
        (PRE, PRE, []),
        (PRE, SAFE, ["start sending"]),
        (PRE, OPER, ["start sending", "start receiving"]),
        (SAFE, PRE, ["stop sending"]),
        (SAFE, SAFE, []),
        (SAFE, OPER, ["start receiving"]),
        (OPER, PRE, ["stop receiving", "stop sending"]),
        (OPER, SAFE, ["stop receiving"]),
        (OPER, OPER, []),
    ],
)
def test_each_request_does_what_lies_between(machine, actions, before, wanted, done):
    machine.request(before)
    actions.done.clear()
    assert machine.request(wanted) == (wanted, None)
    assert actions.done == done


def test_the_device_runs_what_was_checked(machine, actions):
    machine.request(SAFE)
    assert actions.spec is BLANK


@pytest.mark.parametrize(
    ("wanted", "code"),
    [(1, FaultCode.INVALID_REQUEST), (3, FaultCode.UNKNOWN_STATE), (0, FaultCode.UNKNOWN_STATE)],
)
def test_init_and_what_is_no_state_cannot_be_asked_for(machine, wanted, code):
    machine.request(SAFE)
    result = machine.request(wanted)
    assert result.state is SAFE
    assert result.fault is not None
    assert result.fault.code == code


def test_nothing_can_be_asked_for_in_init(actions):
    machine = EapStateMachine(lambda: BLANK, actions)
    result = machine.request(OPER)
    assert result.state is INIT
    assert result.fault is not None
    assert result.fault.code == FaultCode.INVALID_REQUEST


def test_a_refusal_leaves_the_last_state_reached_and_its_reason(machine, actions):
    actions.refuse = "start receiving"
    result = machine.request(OPER)
    assert result.state is SAFE
    assert result.word == 0x14
    assert result.fault is not None
    assert result.fault.text == "engine did not take the configuration: start receiving"
    assert machine.request(SAFE) == (SAFE, None)  # asking for where it stands takes the error away
    actions.refuse = "start sending"
    machine.request(PRE)
    assert machine.request(OPER).state is PRE


def test_what_cannot_run_stays_in_preop_with_the_object_in_the_status(actions):
    ports = empty()
    udp = sender(ports["eap0"])
    machine = EapStateMachine(lambda: read_back(BLANK, ports), actions)
    for each in ports.values():
        machine.serve(each)
    assert udp.upload(0xF100, 1, PREOP) == b"\1\0"
    machine.start()
    write(udp, 0x1A00, 0, 0)
    write(udp, 0xF200, 1, 8)
    assert actions.done == []
    for each in ports.values():
        assert each.upload(0xF100, 1, PREOP) == b"\x12\0"
        assert each.upload(0xF100, 2, PREOP) == b"\x03\x80"
        assert each.upload(0xF100, 3, PREOP).startswith(b"0x1A00:00: PDO maps no variable")
        assert each.upload(0xF100, 4, PREOP) == b"\0\0\x00\x1a"
    write(udp, 0x1A00, 1, 0x6000_0110)
    write(udp, 0x1A00, 0, 1)
    write(udp, 0xF200, 1, 8)
    assert machine.status == (OPER, None)
    assert machine.od_state is OdState.OP
    assert udp.upload(0xF100, 3, PREOP) == b""


def test_what_no_longer_runs_falls_back(machine, actions):
    machine.request(OPER)
    actions.done.clear()
    fault = DeviceFault(FaultCode.NOT_RUNNING, "killed")
    assert machine.fall_back(fault) == (PRE, fault)
    assert actions.done == []
    idle = EapStateMachine(lambda: BLANK, actions)
    assert idle.fall_back(fault).state is INIT


@given(st.lists(st.tuples(st.integers(0, 9), st.sampled_from(["", *"ab"])), max_size=20))
def test_sending_and_receiving_are_on_in_their_states_whatever_is_asked(requests):
    actions = Actions()
    refusals: dict[str, str] = {"": "", "a": "start sending", "b": "start receiving"}
    machine = EapStateMachine(lambda: BLANK, actions)
    machine.start()
    is_on: Callable[[str], bool] = lambda what: (  # noqa: E731
        actions.done.count(f"start {what}") - actions.done.count(f"stop {what}") == 1
    )
    for wanted, refused in requests:
        actions.refuse = refusals[refused]
        result = machine.request(wanted)
        assert is_on("sending") == result.state.sends
        assert is_on("receiving") == result.state.receives
        assert (result.fault is None) == (result.state == wanted)
