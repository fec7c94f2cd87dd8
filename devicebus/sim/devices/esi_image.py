"""EEPROM image of a device from its vendor's description, as a configuration tool writes it."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from devicebus.esi.choice import EsiPlan
from devicebus.esi.names import process_entries
from devicebus.esi.objects import type_of
from devicebus.esi.records import EsiDevice, EsiOpMode, EsiPdo, SmUse
from devicebus.sim.devices.esi import control_of, fixed_size, mailbox_sizes, sm_type
from devicebus.sim.devices.siibuild import SiiStrings, fill, protocols_of
from devicebus.sim.spec import SlaveSpec
from devicebus.wire import sii
from devicebus.wire.sii import (
    Sii,
    SiiCategory,
    SiiDc,
    SiiFixed,
    SiiGeneral,
    SiiPdo,
    SiiPdoEntry,
    SiiPdoHeader,
    SiiSyncManager,
)
from eap.codec import datatypes
from eap.errors import CodecError

# ETG.2010, sync manager element: enable byte.
_ENABLED, _OP_ONLY = 0x01, 0x08
_FIXED, _MANDATORY, _IS_VIRTUAL = 0x0010, 0x0001, 0x0040
_NOT_ASSIGNED = 0xFF
_FMMUS = {"Outputs": 1, "Inputs": 2, "MBoxState": 3, "DynamicOutputs": 1, "DynamicInputs": 2}
_PHYSICS = {"Y": 1, "K": 3, "L": 2, "H": 1}
_MAX_ENTRIES = 0xFF
_OWN = frozenset(SiiCategory)
"""Categories that are made from the description."""
_MINIMUM = 256


def build_image(spec: SlaveSpec, plan: EsiPlan) -> bytes:
    """Return the image of a device.

    Raises:
        ValueError: its description does not fit an EEPROM.
    """
    device = plan.device
    if device.eeprom.image:
        return _given(spec, device)
    strings = SiiStrings(spec.name, device.group or "Devices")
    image = Sii(
        fixed=_fixed(spec, device),
        general=_general(device, strings),
        fmmus=tuple(_FMMUS.get(each.use, 0xFF) for each in device.fmmus),
        sync_managers=_sync_managers(plan),
        rx_pdos=_pdos(plan, strings, is_output=True),
        tx_pdos=_pdos(plan, strings, is_output=False),
        dc=tuple(_dc(each, strings) for each in device.op_modes),
        other=tuple(each for each in device.eeprom.categories if each[0] not in _OWN),
    )
    image = msgspec.structs.replace(image, strings=tuple(strings.texts))
    try:
        return fill(image, max(_MINIMUM, _power_of_two(device.eeprom.byte_size)))
    except CodecError as exc:
        raise ValueError(f"{device.label} does not fit an EEPROM: {exc}") from None


def _given(spec: SlaveSpec, device: EsiDevice) -> bytes:
    """Return the whole image that a file has, with alias and serial number of the slave."""
    try:
        image = sii.decode(device.eeprom.image)
    except CodecError as exc:
        raise ValueError(f"{device.label}: its EEPROM image cannot be used: {exc}") from None
    fixed = msgspec.structs.replace(image.fixed, alias=spec.alias, serial=spec.serial)
    octets = sii.encode(msgspec.structs.replace(image, fixed=fixed))
    return octets.ljust(max(_MINIMUM, len(device.eeprom.image)), b"\xff")


def _power_of_two(size: int) -> int:
    return 1 << max(0, size - 1).bit_length()


def _fixed(spec: SlaveSpec, device: EsiDevice) -> SiiFixed:
    # Words 0 to 6 are the configuration that the controller loads; the check sum follows.
    head = device.eeprom.config_data.ljust(sii.CHECKED, b"\0")
    loaded = SiiFixed.decode(head.ljust(SiiFixed.SIZE, b"\0"))
    boot = device.eeprom.bootstrap.ljust(8, b"\0")
    boot_words = [int.from_bytes(boot[at : at + 2], "little") for at in range(0, 8, 2)]
    sizes = mailbox_sizes(device) if device.mailbox else None
    box = device.sync_managers[:2] if sizes else ()
    return SiiFixed(
        pdi_control=loaded.pdi_control,
        pdi_configuration=loaded.pdi_configuration,
        sync_impulse=loaded.sync_impulse,
        pdi_configuration2=loaded.pdi_configuration2,
        alias=spec.alias or loaded.alias,
        reserved=loaded.reserved,
        vendor=device.vendor,
        product=device.product,
        revision=device.revision,
        serial=spec.serial,
        boot_receive_offset=boot_words[0] if spec.boot else 0,
        boot_receive_size=boot_words[1] if spec.boot else 0,
        boot_send_offset=boot_words[2] if spec.boot else 0,
        boot_send_size=boot_words[3] if spec.boot else 0,
        receive_offset=box[0].start if box else 0,
        receive_size=sizes[0] if sizes else 0,
        send_offset=box[1].start if box else 0,
        send_size=sizes[1] if sizes else 0,
        protocols=protocols_of(spec.mailbox),
    )


def _general(device: EsiDevice, strings: SiiStrings) -> SiiGeneral:
    mailbox = device.mailbox
    coe = mailbox.coe if mailbox else None
    return SiiGeneral(
        group=2,
        order=strings.number(device.type),
        name=1,
        coe_sdo=int(coe is not None),
        coe_info=int(coe is not None and coe.sdo_info),
        coe_pdo_assign=int(coe is not None and coe.pdo_assign),
        coe_pdo_configuration=int(coe is not None and coe.pdo_config),
        coe_startup_upload=int(coe is not None and coe.pdo_upload),
        coe_complete_access=int(coe is not None and coe.complete_access),
        foe=int(mailbox is not None and mailbox.foe),
        eoe=int(mailbox is not None and mailbox.eoe),
        soe_channels=mailbox.soe_channels if mailbox else 0,
        ebus_current=max(-0x8000, min(0x7FFF, device.ebus_ma)),
        port_physics=sum(
            _PHYSICS.get(each, 0) << 4 * port for port, each in enumerate(device.physics[:4])
        ),
    )


def _sync_managers(plan: EsiPlan) -> tuple[SiiSyncManager, ...]:
    found = []
    for number, each in enumerate(plan.device.sync_managers):
        if each.is_mailbox:
            length = (mailbox_sizes(plan.device) or (0, 0))[each.use is SmUse.MAILBOX_IN]
        else:
            bits = sum(pdo.bits for pdo in plan.assignment.get(number, ()))
            length = (bits + 7) // 8 or fixed_size(plan, number)
        enable = _ENABLED * (each.is_enabled and length > 0)
        if each.is_virtual:
            enable = sii.VIRTUAL
        enable |= _OP_ONLY * each.op_only
        found.append(
            SiiSyncManager(each.start, length, control_of(each), enable=enable, type=sm_type(each))
        )
    return tuple(found)


def _pdos(plan: EsiPlan, strings: SiiStrings, *, is_output: bool) -> tuple[SiiPdo, ...]:
    assigned = {pdo.index: number for number, pdos in plan.assignment.items() for pdo in pdos}
    order = list(assigned)
    found = [pdo for pdo in plan.device.pdos if pdo.is_output is is_output]
    # Masters that read no CoE objects take the order of the EEPROM for that of the process data.
    found.sort(key=lambda pdo: order.index(pdo.index) if pdo.index in assigned else len(order))
    return tuple(
        SiiPdo(_header(pdo, assigned.get(pdo.index, _NOT_ASSIGNED), strings),
               _entries([pdo], strings))
        for pdo in found
    )  # fmt: skip


def _header(pdo: EsiPdo, manager: int, strings: SiiStrings) -> SiiPdoHeader:
    flags = _MANDATORY * pdo.is_mandatory | _FIXED * pdo.is_fixed | _IS_VIRTUAL * pdo.is_virtual
    return SiiPdoHeader(pdo.index, 0, manager, name=strings.number(pdo.name), flags=flags)


def _entries(pdos: Iterable[EsiPdo], strings: SiiStrings) -> tuple[SiiPdoEntry, ...]:
    entries = tuple(
        SiiPdoEntry(
            each.index,
            each.subindex,
            name=strings.number(each.name),
            data_type=_type_code(each.type, each.bits) if each.index else 0,
            bit_length=each.bits,
        )
        for each in process_entries(pdos)
    )
    if len(entries) > _MAX_ENTRIES:
        raise ValueError(f"a PDO has {len(entries)} entries, an EEPROM holds {_MAX_ENTRIES}")
    return entries


def _type_code(name: str, bits: int) -> int:
    return datatypes.parse(type_of(name, bits)).code & 0xFF


def _dc(mode: EsiOpMode, strings: SiiStrings) -> SiiDc:
    times = mode.mode
    return SiiDc(
        sync0_cycle=times.cycle0_ns,
        sync0_shift=times.shift0_ns & 0xFFFF_FFFF,
        sync1_shift=times.shift1_ns & 0xFFFF_FFFF,
        sync1_factor=times.factor1,
        assign_activate=times.activate,
        sync0_factor=times.factor0,
        name=strings.number(times.name),
        description=strings.number(mode.description),
    )
