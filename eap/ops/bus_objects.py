"""Objects and IDNs of slaves as typed results: read, written, listed (CoE and SoE)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from typing import Any

from msgspec import UNSET, Struct, UnsetType
from msgspec.structs import replace

from devicebus.errors import MailboxProtocolError, MailboxRefusedError, SoeError
from devicebus.mailbox import coe_client, soe_client
from devicebus.mailbox.conversation import Conversation, reading
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec import datatypes
from eap.codec.coe import EntryDescription
from eap.codec.datatypes import Block, DataType
from eap.codec.soe import (
    Display,
    Element,
    Idn,
    SoeAttribute,
    SoeScalar,
    SoeValue,
    decode_list,
    encode_value,
)
from eap.errors import ConfigError, EapError
from eap.gateway.error_table import Cause, cause_of
from eap.ids import ObjectId
from eap.od.abort import SdoAbortError
from eap.od.model import Access, ObjectCode
from eap.ops.bus_session import Slave, SlaveBus

_TEXT, _OCTETS = 0x09, 0x0A
_NUMBERS = (
    *("BOOL", "SINT", "INT", "DINT", "USINT", "UINT", "UDINT", "REAL", "INT24", "LREAL", "INT40"),
    *("INT48", "INT56", "LINT", "UINT24", "UINT40", "UINT48", "UINT56", "ULINT", "BYTE", "WORD"),
    *("DWORD", *(f"BIT{n}" for n in range(1, 9))),
)
_PLAIN_SIZES = (1, 2, 4, 8)


class SdoValue(Struct, frozen=True, kw_only=True):
    """``eapctl bus sdo read``: an entry or a whole object, bytes in hexadecimal digits."""

    slave: int
    index: int
    subindex: int
    complete: bool
    type: str | None
    value: Any
    data: str


class SdoWritten(Struct, frozen=True, kw_only=True):
    """``eapctl bus sdo write``."""

    slave: int
    index: int
    subindex: int
    complete: bool
    data: str


class SlaveObject(Struct, frozen=True, kw_only=True):
    """Object as the slave describes it."""

    index: int
    name: str
    code: str
    data_type: int
    max_subindex: int


class SdoDumpEntry(Struct, frozen=True, kw_only=True):
    """Entry of a dump: with its value, or with the *error* why there is none."""

    index: int
    subindex: int
    object: str
    name: str
    access: str | UnsetType = UNSET
    type: str | UnsetType | None = UNSET
    value: Any = UNSET
    data: str | UnsetType | None = UNSET
    error: str | UnsetType = UNSET


class IdnElements(Struct, frozen=True, kw_only=True):
    """``eapctl bus idn read``: an IDN with the elements that it has, None for the others."""

    idn: str
    value: SoeValue
    name: str | None
    unit: str | None
    minimum: SoeScalar | None
    maximum: SoeScalar | None
    default: SoeValue | None
    data_state: int | None
    slave: int
    drive: int
    display: str
    octets: int
    decimals: int
    factor: int
    is_list: bool
    is_command: bool
    protected_in: list[str]


class IdnWritten(Struct, frozen=True):
    """``eapctl bus idn write``."""

    slave: int
    drive: int
    idn: str
    value: SoeValue


class NamedIdn(Struct, frozen=True):
    """``eapctl bus idn list``."""

    idn: str
    number: int
    name: str


def read_entry(
    bus: SlaveBus, slave: str, index: int, subindex: int, *, kind: DataType | None, complete: bool
) -> SdoValue:
    """Return an entry, or with *complete* the bytes of an object.

    Raises:
        SdoAbortError: the slave refuses.
        BusError: there is no such slave, or it does not answer.
    """
    unit = bus.find(slave)

    def conversation(sizes: MailboxSizes) -> Conversation[SdoValue]:
        del sizes
        # Value and description in one conversation: no other client can come in between.
        octets = yield from coe_client.upload(index, subindex, complete=complete)
        known = kind
        if known is None and not complete:
            known = yield from _kind_of_entry(index, subindex)
        return SdoValue(
            slave=unit.station,
            index=index,
            subindex=subindex,
            complete=complete,
            type=known.text if known else None,
            value=_value_of(known, octets, complete=complete),
            data=octets.hex(),
        )

    return bus.converse(unit, conversation, _name(index, subindex))


def write_entry(
    bus: SlaveBus,
    slave: str,
    index: int,
    subindex: int,
    text: str,
    *,
    kind: DataType | None,
    complete: bool,
) -> SdoWritten:
    """Write an entry, or with *complete* a whole object given as hexadecimal digits.

    Raises:
        ConfigError: *text* is no value of the entry's type, or the type is not known.
        SdoAbortError: the slave refuses.
        BusError: there is no such slave, or it does not answer.
    """
    unit = bus.find(slave)

    def conversation(sizes: MailboxSizes) -> Conversation[bytes]:
        known = kind
        if known is None and not complete:
            known = yield from _kind_of_entry(index, subindex)
        octets = _octets_of(text, known, _name(index, subindex), complete=complete)
        yield from coe_client.download(index, subindex, octets, sizes, complete=complete)
        return octets

    octets = bus.converse(unit, conversation, _name(index, subindex))
    return SdoWritten(
        slave=unit.station, index=index, subindex=subindex, complete=complete, data=octets.hex()
    )


def list_objects(bus: SlaveBus, slave: str) -> Iterator[SlaveObject]:
    """Yield the description of each object of a slave; raises as read_entry() does."""
    unit = bus.find(slave)
    indexes = bus.converse(unit, lambda _: coe_client.object_list(), "object list")
    for index in indexes:
        yield _described(bus, unit, index)


def dump_entries(bus: SlaveBus, slave: str) -> Iterator[SdoDumpEntry]:
    """Yield every entry of every object with its value; refusals are in *error* of the entry."""
    unit = bus.find(slave)
    for found in list_objects(bus, slave):
        for subindex in range(found.max_subindex + 1):
            entry = _dumped(bus, unit, found, subindex)
            if entry is not None:
                yield entry


def _described(bus: SlaveBus, unit: Slave, index: int) -> SlaveObject:
    found = bus.converse(unit, lambda _: coe_client.object_description(index), _name(index))
    codes = ObjectCode._value2member_map_
    return SlaveObject(
        index=index,
        name=found.name,
        code=ObjectCode(found.code).name if found.code in codes else str(found.code),
        data_type=found.data_type,
        max_subindex=found.max_subindex,
    )


def _dumped(bus: SlaveBus, unit: Slave, found: SlaveObject, subindex: int) -> SdoDumpEntry | None:
    """Return one entry, None for a gap."""
    index, name = found.index, _name(found.index, subindex)
    row = SdoDumpEntry(index=index, subindex=subindex, object=found.name, name="")
    try:
        entry = bus.converse(unit, lambda _: coe_client.entry_description(index, subindex), name)
    except SdoAbortError as exc:
        # Gaps between subindexes are usual, such as 9 to 32 of 0x8nnn (ETG.5001.3); no error of the
        # slave.
        return None if cause_of(exc) is Cause.NOT_FOUND else replace(row, error=str(exc))
    except MailboxProtocolError as exc:  # one bad description is no reason to lose all others
        return replace(row, error=str(exc))
    row = replace(row, name=entry.name, access=_access(entry))
    kind = kind_of(entry)
    type_name = kind.text if kind else None
    if not entry.access & Access.READ_ANY:
        return replace(row, type=type_name, value=None, data=None)
    try:
        octets = bus.converse(unit, lambda _: coe_client.upload(index, subindex), name)
    except (SdoAbortError, MailboxProtocolError) as exc:
        return replace(row, error=str(exc))
    value = _value_of(kind, octets, complete=False)
    return replace(row, type=type_name, value=value, data=octets.hex())


def _name(index: int, subindex: int | None = None) -> str:
    return f"0x{index:04X}" if subindex is None else str(ObjectId(index, subindex))


def _access(entry: EntryDescription) -> str:
    reads = "r" if entry.access & Access.READ_ANY else ""
    return f"{reads}w" if entry.access & Access.WRITE_ANY else reads


def _kind_of_entry(index: int, subindex: int) -> Conversation[DataType | None]:
    """Read an entry's type from the slave; None without a description."""
    try:
        entry = yield from coe_client.entry_description(index, subindex)
    except (SdoAbortError, MailboxRefusedError, MailboxProtocolError):
        return None
    return kind_of(entry)


def kind_of(entry: EntryDescription) -> DataType | None:
    """Return the type of an entry, None if it is none of ours."""
    size = max(1, (entry.bit_length + 7) // 8)
    if entry.data_type == _TEXT:
        return datatypes.parse(f"STRING({size})")
    if entry.data_type == _OCTETS:
        return datatypes.parse(f"BLOCK({size})")
    return _numbers().get(entry.data_type)


@cache
def _numbers() -> dict[int, DataType]:
    return {kind.code: kind for kind in map(datatypes.parse, _NUMBERS)}


def _value_of(kind: DataType | None, octets: bytes, *, complete: bool) -> Any:
    """Return the value of *octets*; None if the type is unknown."""
    if kind is None:
        # Without a type a number is a guess; blocks of these sizes are shown as bytes too (data).
        is_number = not complete and len(octets) in _PLAIN_SIZES
        return int.from_bytes(octets, "little") if is_number else None
    if kind.is_text:
        return octets.rstrip(b"\0").decode(errors="replace")
    if isinstance(kind, Block):
        return octets.hex()
    if len(octets) == kind.size:
        with suppress(ValueError):
            return kind.to_plain(kind.decode(octets, 0))
    return None


def _octets_of(text: str, kind: DataType | None, name: str, *, complete: bool) -> bytes:
    try:
        if complete:
            return bytes.fromhex(text)
        if kind is not None:
            return kind.encode(kind.parse_text(text))
    except (EapError, ValueError) as exc:
        raise ConfigError(f"{name}: {exc}") from None
    raise ConfigError(
        f"{name}: the slave does not describe its type: give it with --type, such as UINT"
    )


def read_idn(bus: SlaveBus, slave: str, idn: Idn, *, drive: int) -> IdnElements:
    """Return an IDN with all elements that it has.

    Raises:
        SoeError: the drive refuses.
        BusError: there is no such slave, or it does not answer.
    """
    unit = bus.find(slave)
    found = bus.converse(unit, lambda _: soe_client.describe(idn, drive=drive), str(idn))
    attribute = found.attribute
    display = attribute.display
    protected = {
        "PREOP": attribute.protected_preop,
        "SAFEOP": attribute.protected_safeop,
        "OP": attribute.protected_op,
    }
    return IdnElements(
        idn=str(idn),
        value=found.value,
        name=found.name,
        unit=found.unit,
        minimum=found.minimum,
        maximum=found.maximum,
        default=found.default,
        data_state=found.data_state,
        slave=unit.station,
        drive=drive,
        display=Display(display).name if display in Display._value2member_map_ else str(display),
        octets=attribute.size,
        decimals=attribute.decimals,
        factor=attribute.factor,
        is_list=bool(attribute.is_list),
        is_command=bool(attribute.is_command),
        protected_in=[state for state, is_protected in protected.items() if is_protected],
    )


def write_idn(bus: SlaveBus, slave: str, idn: Idn, text: str, *, drive: int) -> IdnWritten:
    """Write the value of an IDN; lists are separated by commas.

    Raises:
        ConfigError: *text* is no value of this IDN.
        SoeError: the drive refuses.
        BusError: there is no such slave, or it does not answer.
    """
    unit = bus.find(slave)

    def conversation(sizes: MailboxSizes) -> Conversation[SoeValue]:
        # The attribute tells size and form of the value; SoE data itself has no type.
        octets = yield from soe_client.read(idn, Element.ATTRIBUTE, drive=drive)
        with reading(f"attribute of {idn}"):
            attribute = SoeAttribute.decode(octets)
        value = _parse(attribute, text, idn)
        yield from soe_client.write(idn, _encode(attribute, value, idn), sizes, drive=drive)
        return value

    value = bus.converse(unit, conversation, str(idn))
    return IdnWritten(unit.station, drive, str(idn), value)


def list_idns(bus: SlaveBus, slave: str, *, drive: int) -> Iterator[NamedIdn]:
    """Yield every IDN of a drive with its name; raises as read_idn() does."""
    unit = bus.find(slave)
    for idn in bus.converse(unit, lambda _: soe_client.idn_list(drive=drive), "list of IDNs"):
        yield NamedIdn(str(idn), idn.number, _name_of_idn(bus, unit, idn, drive))


def _name_of_idn(bus: SlaveBus, unit: Slave, idn: Idn, drive: int) -> str:
    return bus.converse(unit, lambda _: _read_name(idn, drive), str(idn))


def _read_name(idn: Idn, drive: int) -> Conversation[str]:
    try:
        octets = yield from soe_client.read(idn, Element.NAME, drive=drive)
    except SoeError:
        return ""
    with reading(f"name of {idn}"):
        return decode_list(octets)[1].rstrip(b"\0").decode(errors="replace")


def _parse(attribute: SoeAttribute, text: str, idn: Idn) -> SoeValue:
    if attribute.display == Display.TEXT:
        return text
    try:
        if not attribute.is_list:
            return _number(attribute, text)
        words = [word for word in text.split(",") if word.strip()]
        values: list[int] | list[float] = [_number(attribute, word) for word in words]
    except ValueError:
        expected = "numbers with commas between" if attribute.is_list else "a number"
        raise ConfigError(f"{idn}: {text!r} is no value of it, expected {expected}") from None
    return values


def _number(attribute: SoeAttribute, text: str) -> SoeScalar:
    if attribute.display == Display.FLOAT:
        return float(text)
    if attribute.display == Display.IDN and "-" in text.strip()[1:]:
        return Idn.parse(text).number
    return int(text, 0)


def _encode(attribute: SoeAttribute, value: SoeValue, idn: Idn) -> bytes:
    try:
        return encode_value(attribute, value)
    except ValueError as exc:
        raise ConfigError(f"{idn}: {exc}") from None
