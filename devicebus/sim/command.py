"""What a running segment can be told: faults, and values that entries are to keep.

A command is one JSON object.  With ``set`` or ``release`` it is about an entry, else it is a fault;
with ``"end": true`` the fault that it describes is over.
"""

from __future__ import annotations

import msgspec

from devicebus.sim.fault import FaultySegment
from devicebus.sim.spec import FaultSpec, Value


class EntryValue(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An entry of a slave and the value that it is to keep."""

    slave: str
    entry: str
    value: Value


class EntryName(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An entry of a slave that may change again."""

    slave: str
    entry: str


class _SetCommand(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    set: EntryValue


class _ReleaseCommand(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    release: EntryName


class FaultCommand(FaultSpec, frozen=True, forbid_unknown_fields=True):
    """A fault; with *end* it is over."""

    end: bool = False


def obey(segment: FaultySegment, command: object, now_ns: int) -> None:
    """Do what *command* says, a JSON object that is decoded.

    Raises:
        ValueError: it says nothing that can be done; the text says why.
    """
    if not isinstance(command, dict):
        raise ValueError("a command is a JSON object")  # noqa: TRY004  the person's, not ours
    try:
        if "set" in command:
            entry = msgspec.convert(command, _SetCommand).set
            segment.set_value(entry.slave, entry.entry, entry.value, now_ns)
        elif "release" in command:
            name = msgspec.convert(command, _ReleaseCommand).release
            segment.release(name.slave, name.entry, now_ns)
        else:
            _check_keys(command)
            _switch(segment, msgspec.convert(command, FaultCommand), now_ns)
    except msgspec.MsgspecError as exc:
        raise ValueError(str(exc)) from None


def _check_keys(command: dict[str, object]) -> None:
    known = (*FaultSpec.__struct_fields__, "end")
    for key in command:
        if key not in known:
            raise ValueError(f"a fault has no key {key!r} (one of {', '.join(known)})")


def _switch(segment: FaultySegment, command: FaultCommand, now_ns: int) -> None:
    given = msgspec.structs.asdict(command)
    is_end = given.pop("end")
    (segment.end if is_end else segment.begin)(FaultSpec(**given), now_ns)
