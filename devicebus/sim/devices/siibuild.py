"""EEPROM image of a simulated device, from its description and dictionary."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import msgspec

from devicebus.sim.devices.objects import (
    MIN_ROOM,
    PDOS,
    RX_ASSIGN,
    RX_PDO,
    TX_ASSIGN,
    TX_PDO,
)
from devicebus.sim.spec import DeviceKind, MailboxSpec, SlaveSpec
from devicebus.wire import sii
from devicebus.wire.sii import (
    Sii,
    SiiDc,
    SiiFixed,
    SiiGeneral,
    SiiPdo,
    SiiPdoEntry,
    SiiPdoHeader,
    SiiProtocol,
    SiiSyncManager,
)
from eap.od.dictionary import ObjectDictionary

PDI_SPI = 0x0805
PDI_DIGITAL = 0x0004
DEVICE_EMULATION = 0x0100
"""ESC configuration, the high byte of word 0."""
IMAGE_SIZE = 2048
RAM = 8192
_FIRST = 0x1000
_NAME, _GROUP = 1, 2
_NOT_ASSIGNED = 0xFF
_MAX_STRINGS = 255
_MAX_STRING = 255
_KIBIT = 128
_MII = 1


class SiiStrings:
    """String category of an image; other categories refer to its strings by number."""

    def __init__(self, *texts: str) -> None:
        self.texts = list(texts)

    def number(self, text: str) -> int:
        """Return the number of *text*, 0 if it cannot be stored."""
        if text in self.texts:
            return self.texts.index(text) + 1
        try:
            size = len(text.encode("latin-1"))
        except UnicodeEncodeError:
            return 0
        if not 0 < size <= _MAX_STRING or len(self.texts) >= _MAX_STRINGS:
            return 0
        self.texts.append(text)
        return len(self.texts)


class SyncManagerLayout(NamedTuple):
    """Addresses of the sync managers, and the numbers of those for outputs and inputs."""

    channels: tuple[SiiSyncManager, ...]
    output_channel: int
    input_channel: int


def plan_channels(
    mailbox: MailboxSpec | None, output_size: int, input_size: int
) -> SyncManagerLayout:
    """Assign addresses to mailboxes and process data, with three buffers for each buffered area.

    The areas also hold the process data that a master can map in addition.

    Raises:
        ValueError: the memory of a controller is too small.
    """
    channels = []
    at = _FIRST
    if mailbox is not None:
        channels.append(SiiSyncManager(at, mailbox.size, 0x26, type=1))
        channels.append(SiiSyncManager(at + mailbox.size, mailbox.size, 0x22, type=2))
        at += 2 * mailbox.size
    first = len(channels)
    at = (at + 7) // 8 * 8
    channels.append(SiiSyncManager(at, output_size, 0x64, enable=int(output_size > 0), type=3))
    # Three buffers, and room for what a master may map in addition.
    at = (at + 3 * max(output_size, MIN_ROOM) + 7) // 8 * 8
    channels.append(SiiSyncManager(at, input_size, 0x20, enable=int(input_size > 0), type=4))
    end = at + 3 * max(input_size, MIN_ROOM)
    if end > _FIRST + RAM:
        raise ValueError(
            f"mailboxes and process data, three times each, take {end - _FIRST} bytes,"
            f" expected at most {RAM}"
        )
    return SyncManagerLayout(tuple(channels), first, first + 1)


def build_image(
    spec: SlaveSpec,
    dictionary: ObjectDictionary,
    layout: SyncManagerLayout,
    *,
    emulates: bool,
    ports: Iterable[int] = (0, 1),
) -> bytes:
    """Return the image, of at least 2 KiB.

    Args:
        spec: Description of the slave.
        dictionary: Its objects, for the PDOs.
        layout: Its sync managers.
        emulates: True for device emulation.
        ports: Its ports.
    """
    mailbox = spec.mailbox
    size = mailbox.size if mailbox else 0
    boot = size if spec.boot else 0
    second = _FIRST + size
    strings = SiiStrings(spec.name, spec.kind.value)
    names = {int(index, 16): name for index, name in spec.pdo_names.items()}
    rx_pdos = _pdos(dictionary, RX_PDO, layout.output_channel, strings, names)
    tx_pdos = _pdos(dictionary, TX_PDO, layout.input_channel, strings, names)
    fixed = SiiFixed(
        pdi_control=PDI_DIGITAL | DEVICE_EMULATION if emulates else PDI_SPI,
        alias=spec.alias,
        vendor=spec.vendor,
        product=spec.product,
        revision=spec.revision or 0,
        serial=spec.serial,
        boot_receive_offset=_FIRST if boot else 0,
        boot_receive_size=boot,
        boot_send_offset=second if boot else 0,
        boot_send_size=boot,
        receive_offset=_FIRST if size else 0,
        receive_size=size,
        send_offset=second if size else 0,
        send_size=size,
        protocols=protocols_of(mailbox),
    )
    return fill(
        Sii(
            fixed=fixed,
            strings=tuple(strings.texts),
            general=_general(spec, ports),
            # Category FMMU counts 1 outputs, 2 inputs, 3 mailbox state, unlike the register's bits.
            fmmus=(1, 2, 3) if mailbox else (1, 2),
            sync_managers=layout.channels,
            rx_pdos=rx_pdos,
            tx_pdos=tx_pdos,
            dc=(SiiDc(assign_activate=0x0300, sync0_factor=1),) if spec.clock else (),
        )
    )


def fill(image: Sii, minimum: int = IMAGE_SIZE) -> bytes:
    """Return the image padded to the size of its EEPROM, at least *minimum*, with that size set."""
    octets = sii.encode(image)
    # EEPROM chips have sizes of powers of two; word 0x3E holds the size in KiBit less one.
    size = minimum
    while size < len(octets):
        size *= 2
    fixed = msgspec.structs.replace(image.fixed, size=size // _KIBIT - 1)
    return sii.encode(msgspec.structs.replace(image, fixed=fixed)).ljust(size, b"\xff")


def _general(spec: SlaveSpec, ports: Iterable[int]) -> SiiGeneral:
    mailbox = spec.mailbox
    coe = int(mailbox is not None and mailbox.coe)
    return SiiGeneral(
        group=_GROUP,
        order=_NAME,
        name=_NAME,
        coe_sdo=coe,
        coe_info=coe,
        coe_pdo_assign=coe,
        coe_pdo_configuration=coe,
        coe_complete_access=coe,
        foe=int(mailbox is not None and mailbox.foe),
        eoe=int(mailbox is not None and mailbox.eoe),
        soe_channels=spec.axes if mailbox is not None and mailbox.soe else 0,
        ds402_channels=spec.axes if spec.kind is DeviceKind.DRIVE else 0,
        port_physics=sum(_MII << 4 * port for port in ports),
    )


def protocols_of(mailbox: MailboxSpec | None) -> int:
    """Return the bits of word 0x1C."""
    if mailbox is None:
        return 0
    # A field of MailboxSpec has the name of its bit.
    return sum(bit for bit in SiiProtocol if getattr(mailbox, str(bit.name).lower()))


def _pdos(
    dictionary: ObjectDictionary,
    base: int,
    channel: int,
    strings: SiiStrings,
    names: Mapping[int, str],
) -> tuple[SiiPdo, ...]:
    found = [item for item in dictionary if 0 <= item.index - base < PDOS]
    assign = dictionary[RX_ASSIGN if base == RX_PDO else TX_ASSIGN]
    assigned = [assign.entries[sub].value for sub in range(1, assign.max_subindex + 1)]
    # Masters that read no CoE objects take the order of the EEPROM for that of the process data.
    found.sort(key=lambda item: _rank(assigned, item.index))
    title = "Outputs" if base == RX_PDO else "Inputs"
    return tuple(
        SiiPdo(
            SiiPdoHeader(
                item.index,
                item.max_subindex,
                # 0xFF: the PDO exists, but no sync manager has it by default.
                channel if item.index in assigned else _NOT_ASSIGNED,
                name=strings.number(
                    names.get(item.index)
                    or (title if len(found) == 1 else f"{title} {item.index - base}")
                ),
            ),
            tuple(
                _pdo_entry(dictionary, item.entries[sub].value, strings)
                for sub in range(1, item.max_subindex + 1)
            ),
        )
        for item in found
    )


def _rank(assigned: list[int], index: int) -> int:
    """Sort key: assigned PDOs come first, in the order of the process data."""
    return assigned.index(index) if index in assigned else len(assigned)


def _pdo_entry(dictionary: ObjectDictionary, number: int, strings: SiiStrings) -> SiiPdoEntry:
    index, subindex, bits = number >> 16, number >> 8 & 0xFF, number & 0xFF
    if not index:
        return SiiPdoEntry(0, 0, bit_length=bits)
    entry = dictionary.entry(index, subindex)
    return SiiPdoEntry(
        index,
        subindex,
        name=strings.number(entry.name),
        data_type=entry.kind.code & 0xFF,
        bit_length=bits,
    )
