"""The EEPROM image of a simulated device, made from its description and dictionary."""

from __future__ import annotations

from typing import NamedTuple

from devicebus.sim.devices.objects import RX_PDO, TX_PDO
from devicebus.sim.spec import MailboxSpec, SlaveSpec
from devicebus.wire import sii
from devicebus.wire.sii import Sii, SiiPdo, SiiProtocol
from devicebus.wire.siirecord import (
    SiiDc,
    SiiFixed,
    SiiGeneral,
    SiiPdoEntry,
    SiiPdoHeader,
    SiiSyncManager,
)
from eap.od.dictionary import ObjectDictionary

PDI_SPI = 0x0805
PDI_DIGITAL = 0x0004
DEVICE_EMULATION = 0x0100
"""In word 0 the high octet is the ESC configuration."""
IMAGE_SIZE = 2048
_FIRST = 0x1000
_NAME, _GROUP = 1, 2


class Layout(NamedTuple):
    """Where the sync managers lie, and which of them carry outputs and inputs."""

    channels: tuple[SiiSyncManager, ...]
    output_channel: int
    input_channel: int


def plan_channels(mailbox: MailboxSpec | None, output_size: int, input_size: int) -> Layout:
    """Place mailboxes and process data; each buffered area has room for its three buffers."""
    channels = []
    at = _FIRST
    if mailbox is not None:
        channels.append(SiiSyncManager(at, mailbox.size, 0x26, type=1))
        channels.append(SiiSyncManager(at + mailbox.size, mailbox.size, 0x22, type=2))
        at += 2 * mailbox.size
    first = len(channels)
    at = (at + 7) // 8 * 8
    channels.append(SiiSyncManager(at, output_size, 0x64, enable=int(output_size > 0), type=3))
    at = (at + 3 * output_size + 7) // 8 * 8
    channels.append(SiiSyncManager(at, input_size, 0x20, enable=int(input_size > 0), type=4))
    return Layout(tuple(channels), first, first + 1)


def build_image(
    spec: SlaveSpec, dictionary: ObjectDictionary, layout: Layout, *, emulates: bool
) -> bytes:
    """Return the image of 2 KiB."""
    mailbox = spec.mailbox
    size = mailbox.size if mailbox else 0
    boot = size if spec.boot else 0
    second = _FIRST + size
    fixed = SiiFixed(
        pdi_control=PDI_DIGITAL | DEVICE_EMULATION if emulates else PDI_SPI,
        alias=spec.alias,
        vendor=spec.vendor,
        product=spec.product,
        revision=spec.revision,
        serial=spec.serial,
        boot_receive_offset=_FIRST if boot else 0,
        boot_receive_size=boot,
        boot_send_offset=second if boot else 0,
        boot_send_size=boot,
        receive_offset=_FIRST if size else 0,
        receive_size=size,
        send_offset=second if size else 0,
        send_size=size,
        protocols=_protocols(mailbox),
        size=IMAGE_SIZE // 128 - 1,
    )
    image = sii.encode(
        Sii(
            fixed=fixed,
            strings=(spec.name, spec.kind.value),
            general=_general(spec),
            fmmus=(1, 2, 3) if mailbox else (1, 2),
            sync_managers=layout.channels,
            rx_pdos=_pdos(dictionary, RX_PDO, layout.output_channel),
            tx_pdos=_pdos(dictionary, TX_PDO, layout.input_channel),
            dc=(SiiDc(assign_activate=0x0300, sync0_factor=1),) if spec.clock else (),
        )
    )
    return image.ljust(IMAGE_SIZE, b"\xff")


def _general(spec: SlaveSpec) -> SiiGeneral:
    mailbox = spec.mailbox
    coe = int(mailbox is not None and mailbox.coe)
    return SiiGeneral(
        group=_GROUP,
        order=_NAME,
        name=_NAME,
        coe_sdo=coe,
        coe_info=coe,
        coe_pdo_assign=coe,
        coe_complete_access=coe,
        foe=int(mailbox is not None and mailbox.foe),
        eoe=int(mailbox is not None and mailbox.eoe),
        soe_channels=int(mailbox is not None and mailbox.soe),
        port_physics=0x1111,
    )


def _protocols(mailbox: MailboxSpec | None) -> int:
    if mailbox is None:
        return 0
    chosen = (
        (mailbox.coe, SiiProtocol.COE),
        (mailbox.foe, SiiProtocol.FOE),
        (mailbox.soe, SiiProtocol.SOE),
        (mailbox.eoe, SiiProtocol.EOE),
        (mailbox.voe, SiiProtocol.VOE),
    )
    return sum(bit for wanted, bit in chosen if wanted)


def _pdos(dictionary: ObjectDictionary, index: int, channel: int) -> tuple[SiiPdo, ...]:
    if index not in dictionary:
        return ()
    item = dictionary[index]
    entries = []
    for sub in range(1, item.max_subindex + 1):
        mapped = int.from_bytes(item.entries[sub].octets, "little")
        place = mapped >> 16, mapped >> 8 & 0xFF
        code = dictionary.entry(*place).kind.code if place[0] else 0
        entries.append(SiiPdoEntry(*place, data_type=code & 0xFF, bit_length=mapped & 0xFF))
    return (SiiPdo(SiiPdoHeader(index, len(entries), channel), tuple(entries)),)
