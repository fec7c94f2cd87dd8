"""The state of any device that ADS reaches, by ReadState and WriteControl."""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Event
from typing import Any

from devicebus.wire.alstatus import state_name
from eap.aoe.ads_operation import ReadState, WriteControl
from eap.aoe.ads_state import BOOT, INIT, OP, PREOP, SAFEOP, states_of
from eap.appliance.commands.ams_device import AmsDevice
from eap.codec.ads import AdsError, AdsStates
from eap.errors import CodecError, ControlError

_NUMBERS = {"INIT": INIT, "PREOP": PREOP, "BOOT": BOOT, "SAFEOP": SAFEOP, "OP": OP}
PATIENCE_S = 10.0
_PAUSE_S = 0.1


def read_state(device: AmsDevice) -> dict[str, Any]:
    """Return the state of a device, as ``eapctl state`` shows it; raises as AmsDevice.demand."""
    return {"state": _now(device), "error": None}


def request_state(
    device: AmsDevice,
    wanted: str,
    *,
    clock: Callable[[], float] = time.monotonic,
    pause: Callable[[float], object] | None = None,
) -> dict[str, Any]:
    """Bring a device to another state, and wait for it.

    Args:
        device: Which.
        wanted: ``INIT``, ``PREOP``, ``BOOT``, ``SAFEOP`` or ``OP``.
        clock: In seconds.
        pause: Lets seconds pass; None really does.

    Raises:
        AmsRefusedError: the device cannot be asked.
    """
    number = _NUMBERS[wanted]
    pause = pause or Event().wait
    outcome = device.ask(WriteControl(states_of(number).ads_state, number, b""))
    if outcome.result == AdsError.ACCESS_DENIED:
        raise device.refusal(outcome.result, wanted)
    now = _now(device)
    deadline = clock() + (0 if outcome.result else PATIENCE_S)
    while now != wanted and clock() < deadline:
        pause(_PAUSE_S)
        now = _now(device)
    if now == wanted:
        return {"state": now, "error": None}
    if outcome.result:
        error = {"code": outcome.result, "text": AdsError.words_of(outcome.result)}
    else:
        error = {"code": 0, "text": f"not there within {PATIENCE_S:g} s"}
    return {"state": now, "error": error}


def _now(device: AmsDevice) -> str:
    data = device.demand(ReadState(), "state")
    try:
        return state_name(AdsStates.decode(data).device_state)
    except CodecError as exc:
        raise ControlError(f"{device.target}: state: {exc}") from None
