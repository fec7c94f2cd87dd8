"""S7 and Modbus: sessions that receive anything, and links whose replies are anything."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from itertools import cycle
from typing import Any

from eap.bridges.field.memory import ServedMemory, ServedPoint
from eap.bridges.field.plan import ReadSpan
from eap.bridges.field.protocol import FieldLink, FieldLinkError, FieldSession
from eap.bridges.modbus.link import ModbusLink
from eap.bridges.modbus.session import ModbusSession
from eap.bridges.s7.link import S7Link
from eap.bridges.s7.session import S7Session
from eap.codec import datatypes
from eap.codec.fieldaddresses import modbus_point, s7_point
from eap.codec.fieldtypes import FieldType, modbus_type, s7_type
from eap.config.bridge_sections import ModbusController, S7Controller
from eap.errors import CodecError
from tools.fuzz.messages import cut

_KINDS = (
    *("BOOL", "REAL", "LREAL", "INT (0..9)", "STRING(6)", "WSTRING(4)", "TIME", "TOD", "DATE"),
    *("DT", "LDT", "BLOCK(5)", "BOOL[9]", "S<8/4:a@0 BOOL8,b@4 REAL>", "E<INT:Off=0,On=1>"),
)
_TYPES: tuple[FieldType, ...] = tuple(
    make(datatypes.parse(kind)) for kind in _KINDS for make in (s7_type, modbus_type)
) + tuple(s7_type(datatypes.parse("LDT"), name) for name in ("DTL", "DATE_AND_TIME"))
_MAX_STEPS = 100


def fuzz_one(data: bytes) -> None:
    """Answer requests, read replies, decode values."""
    memory = _memory()
    for frame in (data, _packet(data), _packet(b"\x32\x01\0\0\0\1" + data), _frame(data)):
        for session in (S7Session(memory), ModbusSession(memory, 1)):
            _answer(session, frame)
    for link in (S7Link(S7Controller(host="a")), ModbusLink(ModbusController(host="a"))):
        _read(link, data)
    for kind in _TYPES:
        if len(data) >= kind.size:
            with suppress(ValueError):
                kind.encode(kind.decode(data[: kind.size]))


def _memory() -> ServedMemory:
    read, write = datatypes.parse("UINT"), datatypes.parse("REAL")
    memory = ServedMemory(
        [
            ServedPoint("m/read", s7_point(read, "DB1.DBW0"), write=False),
            ServedPoint("m/write", s7_point(write, "DB1.DBD2"), write=True),
            ServedPoint("m/read", modbus_point(read, "holding:0"), write=False),
            ServedPoint("m/write", modbus_point(write, "holding:1"), write=True),
        ]
    )
    memory.update("m/read", 1)
    memory.update("m/write", 1.0)
    return memory


def _packet(payload: bytes) -> bytes:
    return b"\3\0" + (len(payload) + 7).to_bytes(2, "big") + b"\2\xf0\x80" + payload


def _frame(pdu: bytes) -> bytes:
    return b"\0\1\0\0" + (len(pdu) + 1).to_bytes(2, "big") + b"\1" + (pdu or b"\0")


def _answer(session: FieldSession, frame: bytes) -> None:
    with suppress(CodecError):
        length = session.frame_length(frame)
        if length is None or length > len(frame):
            return
        answer = session.answer(frame[:length])
        with suppress(StopIteration):
            changes = next(answer)
            while True:
                if set(changes) != {"m/write"}:
                    raise AssertionError(f"a client writes {changes}")
                changes = answer.send("")


def _read(link: FieldLink, data: bytes) -> None:
    replies: Iterator[bytes] = cycle([*cut(data)] or [b""])
    span = ReadSpan("DB1" if isinstance(link, S7Link) else "holding", 0, 32, ())
    talks: tuple[Any, ...] = (link.open(), link.read([span]))
    for talk in talks:
        with suppress(CodecError, FieldLinkError, StopIteration):
            request = next(talk)
            for _ in range(_MAX_STEPS):
                # With the numbers of the request, so that more than the first check is reached.
                head = request[:13] if isinstance(link, S7Link) else request[:7]
                request = talk.send(head + next(replies))
            raise AssertionError("a conversation does not end")
