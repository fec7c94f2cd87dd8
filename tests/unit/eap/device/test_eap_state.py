from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from eap.device.configuration import (
    compare,
    dump_configuration,
    load_configuration,
    read_configuration,
)
from eap.device.eap_spec import read_back
from eap.device.eap_state import EapStateMachine
from eap.od.abort import SdoAbortError
from eap.od.model import OdState
from eap.od.profiles.eap1000 import FrameSub, Rx, Tx, Var
from eap.pd.device import DeviceFault, DeviceState, FaultCode
from eap.pd.spec import StationSpec
from tests.support.downloads import PREOP, receiver, sender, write
from tests.support.examples import examples
from tests.support.stations import BLANK, empty, filled

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
def test_init_and_unknown_states_cannot_be_requested(machine, wanted, code):
    machine.request(SAFE)
    result = machine.request(wanted)
    assert result.state is SAFE
    assert result.fault is not None
    assert result.fault.code == code


def test_no_state_can_be_requested_in_init(actions):
    machine = EapStateMachine(lambda: BLANK, actions)
    result = machine.request(OPER)
    assert result.state is INIT
    assert result.fault is not None
    assert result.fault.code == FaultCode.INVALID_REQUEST


def test_failed_request_keeps_last_state_and_fault(machine, actions):
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


def test_invalid_configuration_stays_in_preop_with_object_in_status(actions):
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


@given(st.lists(st.tuples(st.integers(0, 9), st.sampled_from(["", *"ab"])), max_size=20))
def test_sending_and_receiving_follow_the_state(requests):
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


_NUMBERS = st.integers(0, 2)
_WORDS = st.sampled_from([0x6000_0110, 0x6001_0101, 0x7000_0110, 0x0000_0007, 0x6002_01FF, 0x1234])
_NAMES = st.sampled_from(["a", "b", "c", "two words"])
_TYPES = st.sampled_from(["UINT", "BOOL", "BLOCK(900)", "REAL", "nonsense"])


@st.composite
def _downloads(draw: st.DrawFn) -> tuple[int, int, object]:
    """Most of them sensible by themselves; whether they fit together is left to chance."""
    base, subindex, value = draw(
        st.one_of(
            st.tuples(st.sampled_from([0x6000, 0x7000]), st.just(Var.NAME), _NAMES),
            st.tuples(st.sampled_from([0x6000, 0x7000]), st.just(Var.TYPE_NAME), _TYPES),
            st.tuples(st.sampled_from([0x1A00, 0x1600]), st.integers(0, 3), _WORDS),
            st.tuples(st.sampled_from([0x1A00, 0x1600]), st.just(0), st.integers(0, 3)),
            st.tuples(st.just(0xD000), st.just(Tx.PDO_INDEX), _NUMBERS.map(0x1A00.__add__)),
            st.tuples(st.just(0xD000), st.sampled_from(list(Tx)), st.integers(0, 20)),
            st.tuples(st.just(0xE000), st.just(Rx.PDO_INDEX), _NUMBERS.map(0x1600.__add__)),
            st.tuples(st.just(0xE000), st.just(Rx.FLAGS), st.sampled_from([0x80, 0x85, 0])),
            st.tuples(st.just(0xE000), st.sampled_from(list(Rx)), st.integers(0, 20)),
            st.tuples(
                st.just(0x8000),
                st.integers(FrameSub.TXPD, FrameSub.TXPD + 2),
                _NUMBERS.map(0xD000.__add__),
            ),
            st.tuples(st.just(0x8000), st.sampled_from(list(FrameSub)), st.integers(0, 5)),
            st.tuples(
                st.sampled_from([0x6000, 0x7000, 0x8000, 0xD000, 0xE000]), st.just(0), st.just(0)
            ),
            st.tuples(st.just(0xF810), st.integers(1, 10), st.integers(0, 3)),
            st.tuples(
                st.just(0xF811), st.integers(0, 3), st.sampled_from(["239.1.2.3", "x", "", b"\0"])
            ),
        )
    )
    number = draw(_NUMBERS) if base < 0xF000 else 0
    return base + number, subindex, value


class DeviceMachine(RuleBasedStateMachine):
    """A device with two ports and an engine that believes what it is told."""

    def __init__(self) -> None:
        super().__init__()
        self.ports = empty()
        sender(self.ports["eap0"])
        receiver(self.ports["eap0"])
        self.engine = Actions()
        self.start(PRE)

    def start(self, state: DeviceState) -> None:
        self.machine = EapStateMachine(self.read, self.engine)
        for each in self.ports.values():
            self.machine.serve(each)
            each.on_change = self.change
        self.machine.start()
        assert self.machine.request(state).state is state

    def read(self) -> StationSpec:
        return read_back(BLANK, self.ports)

    def change(self, _index: int, _subindex: int) -> None:
        self.engine.spec = self.read()

    @rule(port=st.sampled_from(["eap0", "eap1"]), where=_downloads())
    def download(self, port: str, where: tuple[int, int, object]) -> None:
        dictionary = self.ports[port]
        before = read_configuration(dictionary)
        try:
            write(dictionary, *where, self.machine.od_state)
        except (SdoAbortError, OverflowError, KeyError):
            assert read_configuration(dictionary) == before

    @rule(wanted=st.sampled_from([PRE, SAFE, OPER, 1]))
    def request(self, wanted: int) -> None:
        before = {name: read_configuration(each) for name, each in self.ports.items()}
        result = self.machine.request(wanted)
        assert (result.fault is None) == (result.state == wanted)
        assert before == {name: read_configuration(each) for name, each in self.ports.items()}

    @rule()
    def restart(self) -> None:
        kept = {name: dump_configuration(each) for name, each in self.ports.items()}
        self.ports = empty()
        for name, each in self.ports.items():
            load_configuration(each, kept[name])
            assert dump_configuration(each) == kept[name]
        before = self.engine
        self.engine = Actions()
        self.start(self.machine.status.state)
        if self.machine.status.state.sends:
            assert self.engine.spec == before.spec

    @rule()
    def write_it_all_again(self) -> None:
        """An empty difference makes another dictionary that runs the same."""
        others = empty()
        for name, each in others.items():
            for change in compare(each, self.ports[name]):
                each.download(change.index, change.subindex, change.data, PREOP)
            assert compare(each, self.ports[name]) == []

    @invariant()
    def what_runs_is_what_the_dictionaries_say(self) -> None:
        if self.machine.status.state.sends:
            assert self.engine.spec == self.read()
            again = filled(self.engine.spec, self.ports)
            assert read_back(self.engine.spec, again) == self.engine.spec


TestDevice = DeviceMachine.TestCase
TestDevice.settings = examples(8, stateful_step_count=25)
