"""What clients of the control socket change, as lines of the audit.

Who may open that socket may do everything; who did what is told all the same.  Nobody can say later
which program a process number was, but whose it was.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

from eap.ads.operation import Operation, Read, ReadWrite
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.coe import CoeHeader, SdoHeader
from eap.codec.mailbox import MailboxType
from eap.control.bus import BusOpenParameters, MailboxData, kind_of
from eap.control.device import ApplyAnswer, StateAnswer
from eap.control.protocol import Request
from eap.gateway.rights import operation_of
from eap.od.abort import SdoAbortError
from eap.services.control.audit import operation_words
from eap.services.transports.accepting import process_of

TellChange: TypeAlias = Callable[[str, str, dict[str, Any]], None]
"""Called with who it was, station, and what is told of the change."""
BeginChange: TypeAlias = Callable[[str, str, dict[str, Any]], str]
"""Called likewise before a change; returns why it may not be done, empty if it may."""
_CHANGES = frozenset(
    (
        *("write", "stop", "od_write", "request_state", "apply", "rollback"),
        *("bus_bring", "bus_fault", "bus_forget", "bus_transfer", "gateway_start", "gateway_stop"),
        *("routes_add", "routes_remove", "routes_import", "routes_add_remote"),
        *("routing_apply", "routing_rollback"),
    )
)
_UNTOLD = frozenset(("password", "spec", "xml", "routing"))
"""Parameters that are secret, or as long as a plant file."""
_READING = frozenset((1, 4, 7))
"""Datagrams that only read: APRD, FPRD, BRD (ETG.1000.4)."""
_EEPROM_OWNER, _EEPROM_CONTROL, _EEPROM_READ = 0x0500, 0x0502, "0001"
"""Registers, and how the command begins that reads (ETG.1000.4)."""
_MAX_WORDS = 200


def peer_of(connection: socket.socket) -> str:
    """Return whose process is at the other end of a Unix socket, and which."""
    pid, uid = process_of(connection)
    return f"uid {uid}, pid {pid}"


def change_of(
    request: Request, opened: Callable[[int], BusOpenParameters | None]
) -> tuple[str, dict[str, Any]] | None:
    """Return the station that a request changes, and what is told of it; None for one that reads.

    Args:
        request: As it came, not checked yet.
        opened: Returns how a conversation with a slave was opened, None if there is none.
    """
    params = request.params
    if request.method == "bus_ask":
        number = params.get("conversation")
        talk = opened(number) if isinstance(number, int) else None
        return None if talk is None else _said(talk, params)
    if request.method not in _CHANGES or (request.method == "bus_transfer" and _only_reads(params)):
        return None
    told = {key: _shortened(value) for key, value in params.items() if key not in _UNTOLD}
    station = str(told.pop("station", "") or str(told.get("target", "")).partition("/")[0])
    return station, {"operation": request.method, "asked": told}


def refusal_in(result: Any, talk: BusOpenParameters | None = None) -> str:
    """Return why a result says that it was not done, empty if it was.

    Args:
        result: Of a request.
        talk: How the conversation was opened that it is an answer of, if it is one.
    """
    if talk is not None and isinstance(result, MailboxData):
        from eap.services.gateway.guard import error_in  # plants without buses have none

        kind, answer = kind_of(talk.protocol), bytes.fromhex(result.data)
        code = error_in(kind, answer)
        if code and kind is MailboxType.COE:
            head = SdoHeader.decode(answer, CoeHeader.SIZE)
            return str(SdoAbortError(head.value, head.index, head.subindex))
        return AdsError.words_of(code) if code else ""
    if isinstance(result, StateAnswer) and result.error is not None:
        return result.error.text
    return "; ".join(result.refused) if isinstance(result, ApplyAnswer) else ""


def _said(talk: BusOpenParameters, params: Mapping[str, Any]) -> tuple[str, dict[str, Any]] | None:
    try:
        body = bytes.fromhex(params["request"])
    except (KeyError, TypeError, ValueError):
        return None
    operation = operation_of(kind_of(talk.protocol), body)
    if operation is None or params.get("listen") or _is_reading(operation):
        return None
    name = f"{talk.station}/{talk.port}/{talk.slave}"
    return talk.station, {"name": name} | dict(operation_words(operation))


def _is_reading(operation: Operation) -> bool:
    is_lookup = isinstance(operation, ReadWrite) and operation.group == IndexGroup.FOE_OPEN_READ
    return is_lookup or isinstance(operation, Read)


def _only_reads(params: Mapping[str, Any]) -> bool:
    rows = params.get("datagrams")
    return not isinstance(rows, list) or all(map(_is_reading_row, rows))


def _is_reading_row(row: Any) -> bool:
    """Say whether a datagram changes nothing; an EEPROM is read by writing a command."""
    match row:
        case [command, *_] if command in _READING:
            return True
        case [_, _, place, data, *_]:
            is_command = place == _EEPROM_CONTROL and str(data).startswith(_EEPROM_READ)
            return is_command or place == _EEPROM_OWNER
    return False


def _shortened(value: Any) -> Any:
    text = str(value)
    return value if len(text) <= _MAX_WORDS else f"{text[:_MAX_WORDS]}…"
