"""EAP state machine: requests of states, checks of transitions, and the last fault.

Rule 1: the device leaves Init at the start and never returns to it.
Rule 2: a request goes through the states in between; if a transition fails, the device stays in the
last state that it reached, and keeps error code and text until a request succeeds.
Rule 3: the transition from PreOp to SafeOp checks the dictionaries as a whole (ETG.1005).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from eap.device.eap_dictionary import EapDictionary
from eap.od.model import OdState
from eap.pd.device import DeviceFault, DeviceState, EapDevice, FaultCode, StateRequest
from eap.pd.spec import StationSpec

ERROR_BIT = 0x10
"""Of the status word, as in the AL status."""

_OD_STATES = {
    DeviceState.PREOP: OdState.PREOP,
    DeviceState.SAFEOP: OdState.SAFEOP,
    DeviceState.OP: OdState.OP,
}
_REQUESTS = {
    DeviceState.PREOP: StateRequest.PREOP,
    DeviceState.SAFEOP: StateRequest.SAFEOP,
    DeviceState.OP: StateRequest.OP,
}


class StateActions(Protocol):
    """Actions of transitions; those that start may raise DeviceFault, those that stop may not."""

    def start_sending(self, spec: StationSpec) -> None:
        """Go from PreOp to SafeOp: run *spec*, which was read back from the dictionaries."""

    def start_receiving(self) -> None:
        """Go from SafeOp to Op."""

    def stop_receiving(self) -> None:
        """Go from Op to SafeOp."""

    def stop_sending(self) -> None:
        """Go from SafeOp to PreOp."""


class StateResult(NamedTuple):
    """State of the device after a request; *fault* is set if it is not the requested state."""

    state: DeviceState
    fault: DeviceFault | None

    @property
    def word(self) -> int:
        """The status word: the state, with bit 4 if there is an error."""
        return self.state | (ERROR_BIT if self.fault is not None else 0)


class EapStateMachine:
    """The state of a station's EAP device.

    Args:
        check: Reads the specification back from the dictionaries; raises DeviceFault.
        actions: Actions of the transitions.
    """

    def __init__(self, check: Callable[[], StationSpec], actions: StateActions) -> None:
        self._check = check
        self._actions = actions
        self._device = EapDevice()
        self._fault: DeviceFault | None = None
        self._dictionaries: list[EapDictionary] = []

    @property
    def status(self) -> StateResult:
        """State and last fault."""
        return StateResult(self._device.state, self._fault)

    @property
    def od_state(self) -> OdState | None:
        """State that decides the access rights of clients; None without a mailbox."""
        return _OD_STATES.get(self._device.state)

    def serve(self, dictionary: EapDictionary) -> None:
        """Show the state in *dictionary* and accept requests from it."""
        self._dictionaries.append(dictionary)
        dictionary.on_request = self.request
        self._show()

    def withdraw(self, dictionary: EapDictionary) -> None:
        """Show nothing in *dictionary* any more, whose port is removed."""
        self._dictionaries.remove(dictionary)

    def start(self, *, has_mailbox: bool = True) -> StateResult:
        """Go from Init to PreOp, once clients can reach the dictionaries."""
        if self._device.state is DeviceState.INIT:
            if has_mailbox:
                self._device.request(StateRequest.START)
                self._fault = None
            else:
                self._fault = DeviceFault(FaultCode.NO_MAILBOX)
        self._show()
        return self.status

    def request(self, wanted: int) -> StateResult:
        """Go to the state numbered *wanted*, or as close to it as possible."""
        try:
            self._walk(_state_of(wanted, self._device.state))
        except DeviceFault as exc:
            self._fault = exc
        else:
            self._fault = None
        self._show()
        return self.status

    def _walk(self, wanted: DeviceState) -> None:
        device, actions = self._device, self._actions
        while device.state < wanted:
            if device.state is DeviceState.PREOP:
                # The state changes behind the action: if that fails the device has not left PreOp.
                actions.start_sending(self._check())
                device.request(StateRequest.SAFEOP)
            else:
                actions.start_receiving()
                device.request(StateRequest.OP)
        # Down: receiving stops before sending, in the reverse order of the way up.
        if device.state is DeviceState.OP and wanted < DeviceState.OP:
            actions.stop_receiving()
        if device.state.sends and not wanted.sends:
            actions.stop_sending()
        device.request(_REQUESTS[wanted])

    def _show(self) -> None:
        for dictionary in self._dictionaries:
            dictionary.show_status(self.status.word, self._fault)


def _state_of(wanted: int, now: DeviceState) -> DeviceState:
    """Return the state numbered *wanted*; raise DeviceFault if it cannot be requested."""
    try:
        state = DeviceState(wanted)
    except ValueError:
        detail = f"{wanted}, there are 2 PreOp, 4 SafeOp and 8 Op"
        raise DeviceFault(FaultCode.UNKNOWN_STATE, detail) from None
    if state is DeviceState.INIT or now is DeviceState.INIT:
        detail = f"{state.name} in {now.name}"
        raise DeviceFault(FaultCode.INVALID_REQUEST, detail)
    return state
