"""Spaces of index groups: the base class, the states of a device, and the system service.

Own mapping of states, for Beckhoff documents none: Op is RUN, SafeOp STOP, PreOp CONFIG, Init INIT;
the device state is the number of the EtherCAT state itself.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from typing import NoReturn, TypeAlias

from eap.ads.request import AdsRefusedError
from eap.codec.ads import AdsError, AdsState, AdsStates, AdsSystemState, IndexGroup

Source: TypeAlias = Callable[[], bytes]
"""Returns the bytes that a notification watches, whenever it is called.

It raises AdsRefusedError: BUSY and NOT_READY for now, anything else for good.
"""


def fixed_size_source(read: Callable[[], bytes], length: int) -> Source:
    """Return a source of *length* bytes; another length ends its notification.

    Raises:
        AdsRefusedError: there are not as many even now, or what *read* raises.
    """

    def source() -> bytes:
        octets = read()
        if len(octets) != length:
            raise AdsRefusedError(AdsError.SIZE)
        return octets

    source()
    return source


class AdsSpace:
    """A family of index groups; what a space does not override is refused.

    Attributes:
        groups: That it answers for.
    """

    groups: Collection[int] = ()

    def read(self, group: int, offset: int, length: int) -> bytes:
        """Return at most *length* bytes; raise AdsRefusedError."""
        del group, offset, length
        _refuse()

    def write(self, group: int, offset: int, data: bytes) -> None:
        """Write *data*, or raise AdsRefusedError and write nothing."""
        del group, offset, data
        _refuse()

    def read_write(self, group: int, offset: int, length: int, data: bytes) -> bytes:
        """Write *data* and return at most *length* bytes; raise AdsRefusedError."""
        del group, offset, length, data
        _refuse()

    def watch(self, group: int, offset: int, length: int) -> Source:
        """Return a source of exactly *length* bytes at this offset; raise AdsRefusedError."""
        del group, offset, length
        _refuse()


def _refuse() -> NoReturn:
    raise AdsRefusedError(AdsError.ACCESS)


States: TypeAlias = Callable[[], AdsStates]
"""Says in which states a device is now."""

INIT, PREOP, BOOT, SAFEOP, OP = 1, 2, 3, 4, 8
"""AL states (ETG.1000.6)."""
_ADS_STATES: dict[int, AdsState] = {
    INIT: AdsState.INIT,
    PREOP: AdsState.CONFIG,
    BOOT: AdsState.LOAD_CONFIG,
    SAFEOP: AdsState.STOP,
    OP: AdsState.RUN,
}
_REQUESTED: dict[int, int] = {
    AdsState.INIT: INIT,
    AdsState.RESET: INIT,
    AdsState.CONFIG: PREOP,
    AdsState.RECONFIG: PREOP,
    AdsState.LOAD_CONFIG: BOOT,
    AdsState.STOP: SAFEOP,
    AdsState.SUSPEND: SAFEOP,
    AdsState.RUN: OP,
    AdsState.START: OP,
    AdsState.RESUME: OP,
}


def states_of(al_state: int) -> AdsStates:
    """Return the ADS states of a device in *al_state*."""
    return AdsStates(_ADS_STATES.get(al_state, AdsState.INVALID), al_state)


def al_state_for(ads_state: int) -> int:
    """Return the AL state that a WriteControl to *ads_state* requests; refuse with VALUE."""
    try:
        # The device state beside it says nothing: clients send back the one that they read before.
        return _REQUESTED[ads_state]
    except KeyError:
        raise AdsRefusedError(AdsError.VALUE) from None


class DeviceDataSpace(AdsSpace):
    """The states of a device as values, to be read and watched."""

    groups: Collection[int] = frozenset((IndexGroup.DEVICE_DATA,))

    def __init__(self, states: States) -> None:
        self._states = states

    def read(self, group: int, offset: int, length: int) -> bytes:
        """Return ADS state and device state from *offset* 0 on, or the latter from 2 on."""
        del group
        if offset not in {0, 2}:
            raise AdsRefusedError(AdsError.INDEX_OFFSET)
        return self._states().encode()[offset : offset + length]

    def watch(self, group: int, offset: int, length: int) -> Source:
        """Return a source of the states."""
        if len(self.read(group, offset, length)) != length:
            raise AdsRefusedError(AdsError.SIZE)
        return partial(self.read, group, offset, length)


class SystemSpace(AdsSpace):
    """State of the whole station; *state* is called for each read."""

    groups: Collection[int] = frozenset((IndexGroup.SYSTEM_STATE,))

    def __init__(self, state: Callable[[], AdsSystemState]) -> None:
        self._state = state

    def read(self, group: int, offset: int, length: int) -> bytes:
        """Return the state, cut to *length*."""
        del group
        if offset:
            raise AdsRefusedError(AdsError.INDEX_OFFSET)
        return self._state().encode()[:length]
