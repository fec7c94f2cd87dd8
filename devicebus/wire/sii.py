"""Slave information interface (SII): EEPROM image of a slave (ETG.1000.6, ETG.2010).

An image is 64 fixed words, then categories; each is a type, a length in words, and its data.  The
type 0xFFFF ends it.  Categories without a decoder stay bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntEnum, IntFlag
from typing import Annotated, Any, NamedTuple, TypeVar

import msgspec

from eap.codec.mailbox import MailboxType
from eap.codec.wire import Buffer, Scalar, WireStruct, bit, bits2, u8, u16, u32
from eap.errors import CodecError, TruncatedError

i16 = Annotated[int, Scalar("h")]


class SiiFixed(WireStruct, frozen=True):
    """ETG.2010 table 2: the first 64 words; offsets and sizes of mailboxes are in bytes."""

    pdi_control: u16 = 0
    pdi_configuration: u16 = 0
    sync_impulse: u16 = 0
    pdi_configuration2: u16 = 0
    alias: u16 = 0
    reserved: Annotated[bytes, Scalar("4s")] = bytes(4)
    checksum: u16 = 0
    vendor: u32 = 0
    product: u32 = 0
    revision: u32 = 0
    serial: u32 = 0
    execution_delay: u16 = 0
    port0_delay: u16 = 0
    port1_delay: u16 = 0
    reserved_delay: u16 = 0
    boot_receive_offset: u16 = 0
    boot_receive_size: u16 = 0
    boot_send_offset: u16 = 0
    boot_send_size: u16 = 0
    receive_offset: u16 = 0
    """Of the mailbox that the master writes."""
    receive_size: u16 = 0
    send_offset: u16 = 0
    send_size: u16 = 0
    protocols: u16 = 0
    reserved_words: Annotated[bytes, Scalar("66s")] = bytes(66)
    size: u16 = 0
    """KiBit of the EEPROM, less one."""
    version: u16 = 1


class SiiGeneral(WireStruct, frozen=True):
    """ETG.2010 table 9: names by string number, protocol details, E-bus current in mA."""

    group: u8 = 0
    image: u8 = 0
    order: u8 = 0
    name: u8 = 0
    reserved: u8 = 0
    coe_sdo: bit = 0
    coe_info: bit = 0
    coe_pdo_assign: bit = 0
    coe_pdo_configuration: bit = 0
    coe_startup_upload: bit = 0
    coe_complete_access: bit = 0
    coe_reserved: bits2 = 0
    foe: u8 = 0
    eoe: u8 = 0
    soe_channels: u8 = 0
    ds402_channels: u8 = 0
    sysman_class: u8 = 0
    flags: u8 = 0
    ebus_current: i16 = 0
    group_copy: u8 = 0
    reserved_octet: u8 = 0
    port_physics: u16 = 0
    """Four bits a port: 0 none, 1 MII, 3 E-bus."""
    physical_memory_address: u16 = 0
    reserved_tail: Annotated[bytes, Scalar("12s")] = bytes(12)


class SiiSyncManager(WireStruct, frozen=True):
    """ETG.2010 table 11; *type* 1 mailbox out, 2 mailbox in, 3 outputs, 4 inputs."""

    start: u16
    length: u16
    control: u8
    status: u8 = 0
    enable: u8 = 1
    type: u8 = 0


VIRTUAL = 0x04
"""Bit of SiiSyncManager.enable: a sync manager that is not set up."""


class SiiPdoHeader(WireStruct, frozen=True):
    """ETG.2010 table 14: a PDO, in front of its entries."""

    index: u16
    entries: u8 = 0
    sync_manager: u8 = 0
    synchronization: u8 = 0
    name: u8 = 0
    flags: u16 = 0


class SiiPdoEntry(WireStruct, frozen=True):
    """ETG.2010 table 14: one mapped entry; index 0 is padding."""

    index: u16
    subindex: u8
    name: u8 = 0
    data_type: u8 = 0
    bit_length: u8 = 0
    flags: u16 = 0


class SiiDc(WireStruct, frozen=True):
    """ETG.2010: one operation mode of distributed clocks; times in nanoseconds."""

    sync0_cycle: u32 = 0
    sync0_shift: u32 = 0
    sync1_shift: u32 = 0
    sync1_factor: i16 = 0
    assign_activate: u16 = 0
    sync0_factor: i16 = 0
    name: u8 = 0
    description: u8 = 0
    reserved: u32 = 0


T = TypeVar("T", bound=WireStruct)

CHECKED = 14
"""Number of bytes at the start that the check sum covers."""
_END = 0xFFFF


class SiiCategory(IntEnum):
    """ETG.2010 table 7: category types."""

    STRINGS = 10
    DATA_TYPES = 20
    GENERAL = 30
    FMMU = 40
    SYNC_MANAGER = 41
    TX_PDO = 50
    RX_PDO = 51
    DC = 60


class SiiProtocol(IntFlag):
    """Mailbox protocols of word 0x1C; each has the name of its :class:`MailboxType`."""

    AOE = 0x01
    EOE = 0x02
    COE = 0x04
    FOE = 0x08
    SOE = 0x10
    VOE = 0x20

    @classmethod
    def of(cls, kind: MailboxType) -> SiiProtocol:
        """Return the bit of a mailbox type, none for a type that an EEPROM cannot name."""
        return cls.__members__.get(kind.name, cls(0))

    @property
    def title(self) -> str:
        """The protocol of one bit as people write it, ``CoE``."""
        return MailboxType[str(self.name)].title


class CategoryHeader(WireStruct, frozen=True):
    """ETG.2010: header of a category; *length* is in words."""

    type: u16
    length: u16


class StringCount(WireStruct, frozen=True):
    """Count of strings, or the length of one string."""

    value: Annotated[int, Scalar("B")]


class SiiPdo(NamedTuple):
    """One PDO with its mapped entries."""

    header: SiiPdoHeader
    entries: tuple[SiiPdoEntry, ...] = ()

    @property
    def bit_length(self) -> int:
        """Sum of the bit lengths of all entries."""
        return sum(entry.bit_length for entry in self.entries)


class Sii(msgspec.Struct, frozen=True, kw_only=True):
    """Decoded image; *other* are the categories without a decoder, by type."""

    fixed: SiiFixed
    strings: tuple[str, ...] = ()
    general: SiiGeneral | None = None
    fmmus: tuple[int, ...] = ()
    """Use of each FMMU: 1 outputs, 2 inputs, 3 mailbox state."""
    sync_managers: tuple[SiiSyncManager, ...] = ()
    tx_pdos: tuple[SiiPdo, ...] = ()
    rx_pdos: tuple[SiiPdo, ...] = ()
    dc: tuple[SiiDc, ...] = ()
    other: tuple[tuple[int, bytes], ...] = ()

    def string(self, number: int) -> str:
        """Return a string as other categories refer to it: 0 and unknown numbers are empty."""
        return self.strings[number - 1] if 0 < number <= len(self.strings) else ""

    @property
    def name(self) -> str:
        """Name of the device; empty without category General."""
        return self.string(self.general.name) if self.general else ""


def checksum(data: Buffer) -> int:
    """Return the CRC-8 of *data*: polynomial 0x07, initial value 0xFF (ESC data sheet, SII)."""
    crc = 0xFF
    for octet in data:
        crc ^= octet
        for _ in range(8):
            crc = (crc << 1 ^ 0x07) & 0xFF if crc & 0x80 else crc << 1
    return crc


def is_intact(data: Buffer) -> bool:
    """Return true if the check sum of the first words is right, so that an ESC loads them."""
    return len(data) > CHECKED and checksum(data[:CHECKED]) == data[CHECKED]


def iter_categories(data: Buffer) -> Iterator[tuple[int, memoryview]]:
    """Yield type and data of each category of a whole image.

    Raises:
        TruncatedError: a category reaches past the image, or the end mark is missing.
    """
    view = memoryview(data)
    offset = SiiFixed.SIZE
    while True:
        # The end mark is a type without a length: the image may end right behind it.
        if offset + 2 <= len(view) and view[offset] == view[offset + 1] == 0xFF:
            return
        header = CategoryHeader.decode(view, offset)
        start = offset + CategoryHeader.SIZE
        offset = start + 2 * header.length
        if offset > len(view):
            raise TruncatedError(
                f"category {header.type} has {header.length} words, but"
                f" {len(view) - start} bytes follow",
                layout="CategoryHeader",
                offset=start,
            )
        yield header.type, view[start:offset]


def decode(data: Buffer) -> Sii:
    """Decode an image without verifying its check sum (:func:`is_intact`).

    Raises:
        TruncatedError: the image, a category or a list in it is shorter than it says.
    """
    found: dict[str, Any] = {"fixed": SiiFixed.decode(data)}
    other = []
    for kind, body in iter_categories(data):
        match kind:
            case SiiCategory.STRINGS:
                found["strings"] = _decode_strings(body)
            case SiiCategory.GENERAL:
                found["general"] = SiiGeneral.decode(body)
            case SiiCategory.FMMU:
                found["fmmus"] = tuple(body)
            case SiiCategory.SYNC_MANAGER:
                found["sync_managers"] = _decode_records(SiiSyncManager, body)
            case SiiCategory.TX_PDO:
                # A category may occur several times: the PDOs of all are joined.
                found["tx_pdos"] = (*found.get("tx_pdos", ()), *_iter_pdos(body))
            case SiiCategory.RX_PDO:
                found["rx_pdos"] = (*found.get("rx_pdos", ()), *_iter_pdos(body))
            case SiiCategory.DC:
                found["dc"] = _decode_records(SiiDc, body)
            case _:
                other.append((kind, bytes(body)))
    return Sii(other=tuple(other), **found)


def encode(sii: Sii) -> bytes:
    """Encode an image with its check sum.

    Raises:
        CodecError: a value does not fit its field.
    """
    fixed = sii.fixed.encode()
    image = bytearray(fixed)
    # The check sum is the low byte of word 7; it covers the words that an ESC loads at power-on.
    image[CHECKED : CHECKED + 2] = bytes((checksum(fixed[:CHECKED]), 0))
    parts = [
        (SiiCategory.STRINGS, _encode_strings(sii.strings) if sii.strings else b""),
        (SiiCategory.GENERAL, sii.general.encode() if sii.general else b""),
        (SiiCategory.FMMU, bytes(sii.fmmus)),
        (SiiCategory.SYNC_MANAGER, b"".join(each.encode() for each in sii.sync_managers)),
        (SiiCategory.TX_PDO, b"".join(map(_encode_pdo, sii.tx_pdos))),
        (SiiCategory.RX_PDO, b"".join(map(_encode_pdo, sii.rx_pdos))),
        (SiiCategory.DC, b"".join(each.encode() for each in sii.dc)),
        *sii.other,
    ]
    for kind, body in parts:
        if body:
            # Lengths are in words, so an odd body gets one byte of padding.
            padded = body + bytes(len(body) % 2)
            image += CategoryHeader(kind, len(padded) // 2).encode() + padded
    return bytes(image + _END.to_bytes(2, "little"))


def _decode_strings(body: memoryview) -> tuple[str, ...]:
    strings = []
    offset = 1
    for _ in range(StringCount.decode(body).value):
        size = StringCount.decode(body, offset).value
        octets = body[offset + 1 : offset + 1 + size]
        if len(octets) < size:
            raise TruncatedError(
                f"a string of {size} bytes, but {len(octets)} follow", layout="StringCount"
            )
        # Latin-1 decodes every byte: an odd character in a name must not fail the image.
        strings.append(bytes(octets).decode("latin-1"))
        offset += 1 + size
    return tuple(strings)


def _encode_strings(strings: tuple[str, ...]) -> bytes:
    body = StringCount(len(strings)).encode()
    for text in strings:
        try:
            octets = text.encode("latin-1")
        except UnicodeEncodeError:
            raise CodecError(f"{text!r} is not Latin-1", layout="StringCount") from None
        body += StringCount(len(octets)).encode() + octets
    return body


def _decode_records(record: type[T], body: memoryview) -> tuple[T, ...]:
    return tuple(
        record.decode(body, at) for at in range(0, len(body) - record.SIZE + 1, record.SIZE)
    )


def _iter_pdos(body: memoryview) -> Iterator[SiiPdo]:
    offset = 0
    while offset < len(body):
        header = SiiPdoHeader.decode(body, offset)
        offset += SiiPdoHeader.SIZE
        end = offset + header.entries * SiiPdoEntry.SIZE
        places = range(offset, end, SiiPdoEntry.SIZE)
        yield SiiPdo(header, tuple(SiiPdoEntry.decode(body, at) for at in places))
        offset = end


def _encode_pdo(pdo: SiiPdo) -> bytes:
    header = msgspec.structs.replace(pdo.header, entries=len(pdo.entries))
    return header.encode() + b"".join(entry.encode() for entry in pdo.entries)
