"""Simulated device of a vendor's description: layout, objects and process data of the real one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping

import msgspec

from devicebus.esi.choice import (
    DETECTED_MODULES,
    MAX_MODULE_LIST,
    MODULE_LIST,
    EsiPlan,
    needs_sync0,
)
from devicebus.esi.names import ProcessEntry, name_entries
from devicebus.esi.objects import type_of
from devicebus.esi.records import (
    EsiDevice,
    EsiInitCommand,
    EsiObject,
    EsiPdo,
    EsiSyncManager,
    SmUse,
)
from devicebus.mailbox.protocol import MINIMUM_SIZE
from devicebus.sim.device import FaultyDictionary
from devicebus.sim.devices.drive import AXIS_OBJECTS
from devicebus.sim.devices.objects import (
    MIN_ROOM,
    PdoRules,
    add_entry,
    assignment,
    described_object,
    identity_objects,
    mapping,
)
from devicebus.sim.devices.siibuild import RAM
from devicebus.sim.pdo import ProcessChannel
from devicebus.sim.spec import ChannelSpec, ClockSpec, MailboxSpec, ProfileKind, SlaveSpec
from eap.ids import ObjectId
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RO, RW, RW_PREOP, Access, Entry, ObjectCode, OdObject, array, record
from eap.suggest import suggest

_STANDARD = frozenset(
    (0x1000, 0x1001, 0x1008, 0x1009, 0x100A, 0x1018, 0x1C00, *range(0x1C10, 0x1C20))
)
_ASSIGN = 0x1C10
_SM_TYPES = {
    SmUse.MAILBOX_OUT: 1,
    SmUse.MAILBOX_IN: 2,
    SmUse.OUTPUTS: 3,
    SmUse.INPUTS: 4,
    SmUse.DYNAMIC_OUTPUTS: 3,
    SmUse.DYNAMIC_INPUTS: 4,
}
_SINGLE_BUFFER = 2
# A buffered sync manager has three areas of its length, one behind the other.
_BUFFERS = 3
_MEMORY = 0x1000
# Addresses have 16 bits, and the first 4 KiB are registers.
_MAX_RAM = 60 << 10
_CONTROL_WORD, _STATUS_WORD = 0x6040, 0x6041
_MAX_AXES = 8
_DEFAULT_MAILBOX = 128


def complete(spec: SlaveSpec, plan: EsiPlan) -> SlaveSpec:
    """Return *spec* completed by its description; its inputs add sources to those of the file.

    Raises:
        ValueError: an input or output of *spec* is none of the file, or does not fit it.
    """
    device = plan.device
    assigned = {pdo.index for pdos in plan.assignment.values() for pdo in pdos}
    own = name_entries(plan.entries(), assigned)
    inputs = [_channel(name, entry) for name, entry in own if not entry.is_output]
    outputs = [_channel(name, entry) for name, entry in own if entry.is_output]
    clock = spec.clock or ClockSpec()
    needs = needs_sync0(device) if clock.needs_sync0 is None else clock.needs_sync0
    return msgspec.structs.replace(
        spec,
        vendor=device.vendor,
        product=device.product,
        revision=device.revision,
        mailbox=_mailbox(device),
        clock=msgspec.structs.replace(clock, needs_sync0=needs) if device.has_dc else None,
        inputs=tuple(_with_sources(inputs, spec.inputs, device)),
        outputs=tuple(_with_sources(outputs, spec.outputs, device)),
        # Without its words for BOOT an EEPROM names no mailbox for that state.
        boot=spec.boot and bool(device.mailbox) and any(device.eeprom.bootstrap),
    )


def _channel(name: str, entry: ProcessEntry) -> ChannelSpec:
    return ChannelSpec(
        name=name,
        type=type_of(entry.type, entry.bits),
        object=f"{entry.index:#06x}:{entry.subindex:02x}",
        bits=entry.bits,
        pdo=entry.pdo,
    )


def _with_sources(
    own: list[ChannelSpec], given: tuple[ChannelSpec, ...], device: EsiDevice
) -> Iterator[ChannelSpec]:
    """Yield the channels of the file; a given one with the same name or object adds its source."""
    left = list(given)
    for channel in own:
        place = ObjectId.parse(channel.object)
        found = next(
            (
                each
                for each in left
                if each.name == channel.name
                or (each.object and ObjectId.parse(each.object) == place)
            ),
            None,
        )
        if found is None:
            yield channel
            continue
        left.remove(found)
        yield msgspec.structs.replace(
            found, name=channel.name, type=channel.type, object=channel.object,
            bits=channel.bits, pdo=channel.pdo,
        )  # fmt: skip
    if left:
        hint = suggest(left[0].name, [each.name for each in own])
        raise ValueError(f"{device.label} has no process data {left[0].name!r}{hint}")


def _mailbox(device: EsiDevice) -> MailboxSpec | None:
    mailbox = device.mailbox
    sizes = mailbox_sizes(device)
    if mailbox is None or sizes is None:
        return None
    return MailboxSpec(
        # More does not fit into the datagram of one frame.
        size=min(max(32, *sizes), 1486),
        coe=mailbox.coe is not None,
        foe=mailbox.foe,
        soe=bool(mailbox.soe_channels),
        eoe=mailbox.eoe,
        voe=mailbox.voe,
        aoe=mailbox.aoe,
    )


def mailbox_sizes(device: EsiDevice) -> tuple[int, int] | None:
    """Return the sizes of the mailboxes to and from the slave; None without mailboxes.

    A mailbox ends where the next sync manager begins, also if its file has it longer.
    """
    found = [each for each in device.sync_managers[:2] if each.is_mailbox]
    if len(found) < 2:
        return None
    sizes = []
    for each in found:
        size = each.default_size or each.min_size or _DEFAULT_MAILBOX
        rooms = (other.start - each.start for other in device.sync_managers)
        sizes.append(min([size, *(room for room in rooms if room >= MINIMUM_SIZE)]))
    return sizes[0], sizes[1]


def is_drive(spec: SlaveSpec, dictionary: ObjectDictionary) -> bool:
    """Return true if the device behaves as a drive of CiA 402.

    Raises ValueError if it should and has no control and status word.
    """
    has_words = axes_of(dictionary) > 0
    if spec.profile is ProfileKind.DRIVE and not has_words:
        raise ValueError("profile drive: the device has no objects 0x6040 and 0x6041")
    return has_words and spec.profile is not ProfileKind.NONE


def axes_of(dictionary: ObjectDictionary) -> int:
    """Return the number of axes with control and status word."""
    count = 0
    while count < _MAX_AXES and all(
        _is_word(dictionary, index + AXIS_OBJECTS * count)
        for index in (_CONTROL_WORD, _STATUS_WORD)
    ):
        count += 1
    return count


def _is_word(dictionary: ObjectDictionary, index: int) -> bool:
    if index not in dictionary:
        return False
    entry = dictionary[index].entries[0]
    return dictionary[index].code is ObjectCode.VAR and entry.kind.bit_length == 16


def process_channels(plan: EsiPlan) -> tuple[ProcessChannel, ...]:
    """Return the sync managers of the process data; virtual ones need no channel."""
    return tuple(
        ProcessChannel(
            number,
            _ASSIGN + number,
            is_output=each.is_output,
            fixed_size=fixed_size(plan, number),
            is_single=control_of(each) & 3 == _SINGLE_BUFFER,
        )
        for number, each in enumerate(plan.device.sync_managers)
        if not each.is_mailbox and not each.is_virtual and is_used(each)
    )


def is_used(manager: EsiSyncManager) -> bool:
    """Return true if process data is exchanged in each cycle; dynamic ones are set up on demand."""
    return manager.use in {SmUse.OUTPUTS, SmUse.INPUTS}


def fixed_size(plan: EsiPlan, number: int) -> int:
    """Return the size of a sync manager to which no PDO can be assigned."""
    manager = plan.device.sync_managers[number]
    if plan.coe is not None:
        return 0  # its assignment object says what it has
    can_have = any(
        pdo.is_output is manager.is_output and pdo.sync_manager in {None, number}
        for pdo in plan.device.pdos
    )
    return 0 if can_have or not manager.is_enabled else manager.default_size or 0


def memory_size(plan: EsiPlan, channels: Iterable[ProcessChannel]) -> int:
    """Return the size of the controller's memory that holds all areas, 8 KiB at least."""
    ends = [each.start + (each.default_size or 0) for each in plan.device.sync_managers]
    ends += [
        plan.device.sync_managers[each.number].start + _BUFFERS * max(each.size, MIN_ROOM)
        for each in channels
    ]
    return min(_MAX_RAM, max([RAM, *(end - _MEMORY for end in ends)]) + 1023 & ~1023)


_CONTROLS = {1: 0x26, 2: 0x22, 3: 0x24, 4: 0x20}


def control_of(manager: EsiSyncManager) -> int:
    """Return the control byte of a sync manager, by its use if the file has none."""
    if manager.control is None:
        return _CONTROLS[_SM_TYPES[manager.use]]
    return manager.control


def sm_type(manager: EsiSyncManager) -> int:
    """Return the type of a sync manager as 0x1C00 and the EEPROM have it."""
    return _SM_TYPES[manager.use]


def build_dictionary(spec: SlaveSpec, plan: EsiPlan, device_type: int) -> ObjectDictionary:
    """Build the dictionary of a device; with SoE it is an internal one of IDNs.

    Raises:
        ValueError: a type, a value or a PDO cannot be used.
    """
    device = plan.device
    dictionary = FaultyDictionary()
    if not device.is_soe:
        for each in identity_objects(spec, _device_type(device, device_type)):
            dictionary.add(each)
    for described in spec.objects:
        dictionary.add(described_object(described))
    pdos = {pdo.index for pdo in device.pdos}
    for item in device.objects:
        if item.index not in dictionary and item.index not in _STANDARD | pdos:
            dictionary.add(_object(item))
    _add_entries(spec, plan, dictionary)
    _add_pdos(plan, dictionary)
    if not device.is_soe:
        types = [sm_type(each) for each in device.sync_managers]
        dictionary.add(array(0x1C00, "Sync manager type", "USINT", types))
        if device.slots:
            _add_modules(plan, dictionary)
        for command in device.init_commands:
            if not command.is_soe:
                _add_written(command, dictionary)
    return dictionary


def _add_written(command: EsiInitCommand, dictionary: ObjectDictionary) -> None:
    """Add the target of a start-up write that the dictionary of the file leaves out."""
    known = dict(dictionary[command.index].entries) if command.index in dictionary else {}
    if known and (command.complete_access or command.subindex in known):
        return
    data, name = command.data, command.comment or f"0x{command.index:04X}"
    if command.complete_access and data and data[0]:
        # Subindex 0 takes two bytes, all entries have the same size.
        size = max(1, (len(data) - 2) // data[0])
        entries = {sub: _unknown(size, name) for sub in range(1, data[0] + 1)}
        dictionary.add(record(command.index, name, entries))
    elif command.subindex == 0:
        entry = _unknown(len(data), name)
        dictionary.add(OdObject(command.index, name, ObjectCode.VAR, {0: entry}))
    else:
        known.pop(0, None)
        known[command.subindex] = _unknown(len(data), name)
        dictionary.add(record(command.index, name, known))


def _unknown(size: int, name: str) -> Entry:
    return Entry(name, type_of("", 8 * max(1, size)), RW)


def _device_type(device: EsiDevice, default: int) -> int:
    found = next((each for each in device.objects if each.index == 0x1000), None)
    if found is not None and found.entries[0].default:
        return int.from_bytes(found.entries[0].default, "little") & 0xFFFF_FFFF
    return default if device.profile_number is None else device.profile_number


def _object(item: EsiObject) -> OdObject:
    entries: dict[int, Entry] = {}
    for each in item.entries:
        entry = Entry(each.name, each.type, each.access)
        if each.default is not None:
            octets = each.default.rstrip(b"\0") if entry.is_text else each.default
            entry.default = entry.octets = octets
        entries[each.subindex] = entry
    if item.is_record:
        return record(item.index, item.name, entries)
    return OdObject(item.index, item.name, ObjectCode.VAR, entries)


def _add_entries(spec: SlaveSpec, plan: EsiPlan, dictionary: ObjectDictionary) -> None:
    """Add the entries of all PDOs; one that is mapped with several lengths has the longest."""
    widest: dict[tuple[int, int], int] = {}
    for entry in plan.entries():
        place = entry.index, entry.subindex
        widest[place] = max(entry.bits, widest.get(place, 0))
    by_name = {(channel.object, channel.pdo): channel for channel in (*spec.inputs, *spec.outputs)}
    for entry in plan.entries():
        if not entry.index:
            continue
        given = by_name.get((f"{entry.index:#06x}:{entry.subindex:02x}", entry.pdo))
        channel = ChannelSpec(
            name=entry.name or f"{entry.index:04X}:{entry.subindex:02X}",
            type=type_of(entry.type, widest[entry.index, entry.subindex]),
            value=given.value if given is not None else 0,
        )
        right = Access.RX_MAPPABLE if entry.is_output else Access.TX_MAPPABLE
        add_entry(
            dictionary,
            entry.index,
            entry.subindex,
            channel,
            (RW if entry.is_output else RO) | right,
        )


def _add_pdos(plan: EsiPlan, dictionary: ObjectDictionary) -> None:
    device = plan.device
    mapped: dict[int, list[tuple[int, int, int]]] = {pdo.index: [] for pdo in device.pdos}
    for entry in plan.entries():
        mapped[entry.pdo].append((entry.index, entry.subindex, entry.bits))
    for pdo in device.pdos:
        if pdo.index in dictionary:
            raise ValueError(f"PDO 0x{pdo.index:04X} is there twice, or is an object as well")
        dictionary.add(
            mapping(
                pdo.index,
                mapped[pdo.index],
                dictionary,
                is_output=pdo.is_output,
                is_fixed=plan.has_fixed_mapping(pdo),
            )
        )
    excludes = _exclusions(device.pdos)
    for number, manager in enumerate(device.sync_managers):
        if manager.is_mailbox:
            continue
        rules = PdoRules(
            frozenset(pdo.index for pdo in device.pdos if pdo.is_output is manager.is_output),
            excludes,
            is_fixed=not plan.takes_assignment,
        )
        pdos = [pdo.index for pdo in plan.assignment.get(number, ())]
        dictionary.add(
            assignment(_ASSIGN + number, pdos, dictionary, rules, is_output=manager.is_output)
        )


def _exclusions(pdos: Iterable[EsiPdo]) -> Mapping[int, frozenset[int]]:
    found: dict[int, set[int]] = {}
    for pdo in pdos:
        for other in pdo.excludes:
            found.setdefault(pdo.index, set()).add(other)
            found.setdefault(other, set()).add(pdo.index)
    return {index: frozenset(others) for index, others in found.items()}


def _add_modules(plan: EsiPlan, dictionary: ObjectDictionary) -> None:
    """Add the lists of configured and detected modules (ETG.5001)."""
    modules = plan.modules[:MAX_MODULE_LIST]
    if DETECTED_MODULES not in dictionary:
        dictionary.add(array(DETECTED_MODULES, "Detected module ident list", "UDINT", modules))
    if MODULE_LIST not in dictionary:
        entries = {
            subindex: Entry(f"SubIndex {subindex:03}", "UDINT", RW_PREOP, ident)
            for subindex, ident in enumerate(modules, 1)
        }
        entries[0] = Entry("SubIndex 000", "USINT", RW_PREOP, len(modules), maximum=len(modules))
        name = "Configured module ident list"
        dictionary.add(OdObject(MODULE_LIST, name, ObjectCode.ARRAY, entries, data_type=0x07))


def channel_names(spec: SlaveSpec) -> dict[str, tuple[int, int]]:
    """Return the entries by names: PDO and entry, and the entry alone where it is unique."""
    channels = [each for each in (*spec.inputs, *spec.outputs) if each.object]
    short = Counter(each.name.partition(".")[2] for each in channels)
    found: dict[str, tuple[int, int]] = {}
    for each in channels:
        place = ObjectId.parse(each.object)
        found[each.name] = place
        alone = each.name.partition(".")[2]
        if alone and short[alone] == 1:
            found.setdefault(alone, place)
    return found
