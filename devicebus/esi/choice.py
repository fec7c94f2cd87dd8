"""Rules of device descriptions: revision, default PDO assignment, modules in slots."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import msgspec

from devicebus.esi.content import ListedDevice
from devicebus.esi.device import MAX_SLOTS
from devicebus.esi.names import ProcessEntry, process_entries
from devicebus.esi.records import (
    EsiCoe,
    EsiDevice,
    EsiInitCommand,
    EsiModule,
    EsiObject,
    EsiPdo,
    EsiPdoEntry,
    EsiSlot,
)
from eap.od.slave_config import (
    ALIAS_REGISTER,
    ID_REGISTER,
    IdnWrite,
    RevisionRule,
    SdoWrite,
    SlaveConfig,
    Transition,
)
from eap.suggest import suggest

MODULE_LIST = 0xF030
"""Object with the idents of the configured modules (ETG.5001)."""
DETECTED_MODULES = 0xF050
"""Object with the idents of the modules that are there (ETG.5001)."""
MAX_MODULE_LIST = 254
"""Modules that either object can list."""
_SYNC0 = 0x0200
"""Bit of AssignActivate: register 0x0981, bit 1."""
_LOW = 0xFFFF
_MAX_INDEX = 0xFFFF
_SHOWN_TYPES = 12
_DESIGNATION = re.compile(r"(.+)-(\d{4})-(\d{4})", re.ASCII)


class DeviceQuery(NamedTuple):
    """A device as it is looked for; 0, None and an empty text stand for any."""

    vendor: int = 0
    product: int = 0
    type: str = ""
    """Type as it is printed on the device, EL2004; case does not matter."""
    revision: int | None = None

    def fits(self, device: ListedDevice) -> bool:
        """Return true if *device* fits, whatever its revision is."""
        return (
            self.vendor in {0, device.vendor}
            and self.product in {0, device.product}
            and self.type.casefold() in {"", device.type.casefold()}
        )

    def designated(self) -> DeviceQuery:
        """Return the query that a type with version and revision means, else this one.

        That is Beckhoff's designation of a device: EL3314-0010-0016 is revision 16 of version 10.
        Both numbers are decimal, although the revision number of the ESI file holds the one in its
        high and the other in its low word.

        Raises:
            ValueError: the query has another revision, too.
        """
        match = _DESIGNATION.fullmatch(self.type)
        if match is None:
            return self
        base, version = match[1], int(match[2])
        revision = int(match[3]) << 16 | version
        if self.revision not in {None, revision}:
            raise ValueError(f"{self.type} is revision 0x{revision:08X}, not 0x{self.revision:08X}")
        # Types have no -0000: the basic version is left out.
        return self._replace(type=f"{base}-{match[2]}" if version else base, revision=revision)

    def __str__(self) -> str:
        parts = [self.type] if self.type else []
        if self.vendor:
            parts.append(f"vendor 0x{self.vendor:08X}")
        if self.product:
            parts.append(f"product 0x{self.product:08X}")
        return ", ".join(parts) or "any device"


def choose_devices(devices: Iterable[ListedDevice], query: DeviceQuery) -> list[ListedDevice]:
    """Return the devices that a configuration names, the best first; a revision is meant exactly.

    The type may be a whole designation, unless a device has it for its type.  Without a revision
    the highest comes first, and those without a special version (low word 0) before the others.
    Old revisions that a newer one hides are lower than it, so they need no rule.

    Raises:
        ValueError: there is none; the message has the known types or revisions.
    """
    known = list(devices)
    found = [each for each in known if query.fits(each)]
    if not found:
        query = query.designated()
        found = [each for each in known if query.fits(each)]
    if not found:
        raise ValueError(_no_device(known, query))
    if query.revision is None:
        return sorted(
            found, key=lambda each: (not each.revision & _LOW, each.revision), reverse=True
        )
    exact = [each for each in found if each.revision == query.revision]
    if not exact:
        revisions = ", ".join(f"0x{each:08X}" for each in sorted({d.revision for d in found}))
        raise ValueError(f"{query} has no revision 0x{query.revision:08X}; known: {revisions}")
    return exact


def _no_device(known: Sequence[ListedDevice], query: DeviceQuery) -> str:
    """Return the reason that none of the *known* devices fits *query*."""
    if not known:
        return "no device in its ESI files"
    named = query.type.casefold()
    others = {f"0x{each.product:08X}" for each in known if each.type.casefold() == named}
    if others and query.product:
        products = ", ".join(sorted(others))
        return f"{query.type} has product {products}, not 0x{query.product:08X}"
    types = list(dict.fromkeys(each.type for each in known))
    hint = suggest(query.type, types) if query.type else ""
    if not hint and len(types) <= _SHOWN_TYPES:
        hint = f"; known: {', '.join(types)}"
    number = "its device is not" if len(known) == 1 else f"none of {len(known)} devices is"
    return f"{number} {query}{hint}"


def match_slave(devices: Iterable[ListedDevice], query: DeviceQuery) -> list[ListedDevice]:
    """Return the descriptions of a slave with the revision of *query*, the best first.

    That is the one of its revision, also if a newer one hides it, then those that are not above
    it: the high word counts, the low word is a special version and must be the same.
    """
    found = [each for each in devices if query.fits(each)]
    if query.revision is not None:
        low = query.revision & _LOW
        found = [d for d in found if d.revision & _LOW == low and d.revision <= query.revision]
    return sorted(found, key=lambda each: each.revision, reverse=True)


def default_assignment(device: EsiDevice) -> dict[int, tuple[EsiPdo, ...]]:
    """Return the PDOs that each sync manager of process data has by default.

    These are the PDOs with a sync manager and the mandatory ones; of PDOs that exclude each other
    the first one counts.
    """
    chosen: dict[int, list[EsiPdo]] = {
        number: [] for number, each in enumerate(device.sync_managers) if not each.is_mailbox
    }
    taken: dict[int, EsiPdo] = {}
    for pdo in device.pdos:
        number = pdo.sync_manager
        if number is None and pdo.is_mandatory:
            number = manager_for(device, pdo)
        if number not in chosen or pdo.index in taken:
            continue
        if conflict(pdo, taken.values()) is None:
            chosen[number].append(pdo)
            taken[pdo.index] = pdo
    return {number: tuple(pdos) for number, pdos in chosen.items()}


def conflict(pdo: EsiPdo, others: Iterable[EsiPdo]) -> EsiPdo | None:
    """Return the one of *others* that cannot be assigned together with *pdo*, or None."""
    return next(
        (each for each in others if each.index in pdo.excludes or pdo.index in each.excludes), None
    )


def manager_for(device: EsiDevice, pdo: EsiPdo) -> int | None:
    """Return the sync manager of a PDO, for one without its own the first of its direction."""
    if pdo.sync_manager is not None:
        return pdo.sync_manager
    return next(
        (
            number
            for number, each in enumerate(device.sync_managers)
            # A virtual one takes no PDO: an FMMU maps registers in its place.
            if not each.is_mailbox and each.is_output is pdo.is_output and not each.is_virtual
        ),
        None,
    )


def expand_slots(device: EsiDevice) -> tuple[EsiSlot, ...]:
    """Return the slot of each position: one that takes several modules is there as often."""
    positions: list[EsiSlot] = []
    for slot in device.slots:
        positions += [slot] * min(max(1, slot.max_instances), MAX_SLOTS - len(positions))
    return tuple(positions)


def default_modules(device: EsiDevice) -> tuple[EsiModule | None, ...]:
    """Return the module at each position by default: the default of its slot, or a needed one."""
    found: list[EsiModule | None] = []
    for slot in device.slots:
        fitting = [module for module in device.modules if fits_slot(module, slot)]
        usual = next((module for module in fitting if module.ident == slot.default), None)
        needed = usual or (fitting[0] if len(fitting) == 1 else None)
        count = max(slot.min_instances, int(usual is not None))
        room = min(max(1, slot.max_instances), MAX_SLOTS - len(found))
        found += [needed if number < count else None for number in range(room)]
    while found and found[-1] is None:
        found.pop()
    return tuple(found)


def fits_slot(module: EsiModule, slot: EsiSlot) -> bool:
    """Return true if *module* may be in *slot*."""
    return module.ident in slot.idents or (
        bool(module.module_class) and module.module_class in slot.classes
    )


def find_modules(
    device: EsiDevice, names: Sequence[str | int | None]
) -> tuple[EsiModule | None, ...]:
    """Return the modules with the given idents, types or names, None for an empty position.

    Raises:
        ValueError: a module is unknown, or does not fit its position.
    """
    slots = expand_slots(device)
    if len(names) > len(slots):
        there = f"{len(slots)} slot{'s' * (len(slots) != 1)}" if slots else "no slots for modules"
        raise ValueError(f"{device.label} has {there}, but {len(names)} in modules")
    return tuple(
        None if name is None else _find_module(device, name, slots[number], number)
        for number, name in enumerate(names)
    )


def _find_module(device: EsiDevice, name: str | int, slot: EsiSlot, number: int) -> EsiModule:
    for module in device.modules:
        wanted = str(name).casefold()
        same = module.ident == name or wanted in {module.type.casefold(), module.name.casefold()}
        if same and fits_slot(module, slot):
            return module
    shown = f"0x{name:08X}" if isinstance(name, int) else repr(name)
    known = [module.type for module in device.modules if fits_slot(module, slot)]
    hint = suggest(str(name), known)
    raise ValueError(f"{device.label}: no module {shown} fits slot {number}{hint}")


def with_modules(device: EsiDevice, modules: Sequence[EsiModule | None]) -> EsiDevice:
    """Return the device with the PDOs, start-up writes and objects of its modules.

    Indexes that depend on the slot grow with its number by the steps of the slot (ETG.5001).

    Raises:
        ValueError: two modules have a PDO in common, or an index leaves its range.
    """
    slots = expand_slots(device)
    pdos: dict[int, EsiPdo] = {}
    commands: list[EsiInitCommand] = []
    objects: dict[int, EsiObject] = {each.index: each for each in device.objects}
    for number, module in enumerate(modules):
        if module is None:
            continue
        slot = slots[number]
        for pdo in module.pdos:
            moved = _moved_pdo(pdo, slot, number)
            if moved.index in pdos:
                raise ValueError(
                    f"{device.label}: the module of slot {number} has PDO 0x{moved.index:04X},"
                    " which another slot has"
                )
            pdos[moved.index] = moved
        commands += _moved_commands(module, slot, number)
        shift = number * slot.index_step
        for each in module.objects:
            index = _index(each.index + shift, device)
            objects.setdefault(index, msgspec.structs.replace(each, index=index))
    own = [pdo for pdo in device.pdos if pdo.index not in pdos]
    kept = [
        each
        for each in device.init_commands
        if not (each.overwritten_by_module and any(_same(each, other) for other in commands))
    ]
    return msgspec.structs.replace(
        device,
        pdos=(*own, *pdos.values()),
        init_commands=(*kept, *commands),
        objects=tuple(objects.values()),
    )


def _index(index: int, device: EsiDevice) -> int:
    if index > _MAX_INDEX:
        raise ValueError(f"{device.label}: object 0x{index:X} of a module is above 0xFFFF")
    return index


def _moved_pdo(pdo: EsiPdo, slot: EsiSlot, number: int) -> EsiPdo:
    shift = number * slot.index_step
    entries = tuple(
        _moved_entry(entry, shift) if entry.depends_on_slot else entry for entry in pdo.entries
    )
    index = pdo.index + (number * slot.pdo_step if pdo.depends_on_slot else 0)
    if max((entry.index for entry in entries), default=0) > _MAX_INDEX or index > _MAX_INDEX:
        raise ValueError(f"PDO 0x{pdo.index:04X} of the module in slot {number} is above 0xFFFF")
    return msgspec.structs.replace(pdo, index=index, entries=entries)


def _moved_entry(entry: EsiPdoEntry, shift: int) -> EsiPdoEntry:
    return msgspec.structs.replace(entry, index=entry.index + shift)


def _moved_commands(module: EsiModule, slot: EsiSlot, number: int) -> Iterator[EsiInitCommand]:
    for each in module.init_commands:
        shift = number * slot.index_step if each.depends_on_slot else 0
        yield msgspec.structs.replace(each, index=(each.index + shift) & _MAX_INDEX)


def _same(one: EsiInitCommand, other: EsiInitCommand) -> bool:
    return (one.index, one.subindex, one.is_soe) == (other.index, other.subindex, other.is_soe)


def needs_sync0(device: EsiDevice) -> bool:
    """Return true if every operation mode of the device uses SYNC0."""
    return bool(device.op_modes) and all(each.mode.activate & _SYNC0 for each in device.op_modes)


class EsiPlan(NamedTuple):
    """Device with its modules, and the PDOs of its sync managers by default."""

    device: EsiDevice
    assignment: dict[int, tuple[EsiPdo, ...]]
    modules: tuple[int, ...] = ()
    """Idents of the modules in the slots, 0 for none."""

    @property
    def coe(self) -> EsiCoe | None:
        """Its CoE, None without one."""
        return self.device.mailbox.coe if self.device.mailbox else None

    @property
    def takes_assignment(self) -> bool:
        """True if a master may change the PDO assignment."""
        return self.coe is not None and self.coe.pdo_assign

    def has_fixed_mapping(self, pdo: EsiPdo) -> bool:
        """Return true if a master cannot change the entries of *pdo*."""
        if self.device.is_soe:
            return False  # the lists S-0-0016 and S-0-0024 change a telegram
        return pdo.is_fixed or self.coe is None or not self.coe.pdo_config

    def entries(self) -> Iterator[ProcessEntry]:
        """Yield the entries of all PDOs, assigned or not."""
        yield from process_entries(self.device.pdos, is_soe=self.device.is_soe)


def plan_device(device: EsiDevice, modules: Sequence[int | str | None] | None = None) -> EsiPlan:
    """Return the plan of a device with *modules*; None for its defaults.

    Raises:
        ValueError: a module does not fit, or there are more than the device can be told of.
    """
    chosen = default_modules(device) if modules is None else find_modules(device, modules)
    if device.downloads_modules and len(chosen) > MAX_MODULE_LIST:
        raise ValueError(
            f"{device.label} has {len(chosen)} modules, object 0x{MODULE_LIST:04X} lists at most"
            f" {MAX_MODULE_LIST}"
        )
    whole = with_modules(device, chosen)
    idents = tuple(module.ident if module else 0 for module in chosen)
    return EsiPlan(whole, default_assignment(whole), idents)


def default_config(plan: EsiPlan) -> SlaveConfig:
    """Return the configuration that a tool gives a slave with this description.

    The list of the idents of its modules where the slave wants it, its PDO assignment where the
    slave takes one, its start-up writes, its first operation mode, time-outs and the rule for its
    revision.
    """
    device = plan.device
    mode = device.op_modes[0].mode if device.op_modes else None
    identification = ID_REGISTER if device.has_reg134_identification else ALIAS_REGISTER
    return SlaveConfig(
        assignment={
            number: tuple(pdo.index for pdo in pdos)
            for number, pdos in plan.assignment.items()
            if plan.takes_assignment
            and any(manager_for(device, pdo) == number for pdo in device.pdos)
        },
        fixed_pdos=not plan.takes_assignment,
        writes=(*_module_list(plan), *_writes(device)),
        # AssignActivate is registers 0x0980 and 0x0981: without the high byte no SYNC runs.
        sync=mode if mode is not None and mode.activate >> 8 else None,
        timeouts=device.timeouts,
        revision_rule=device.revision_rule or RevisionRule.EXACT,
        identification=identification,
    )


def _module_list(plan: EsiPlan) -> Iterator[SdoWrite]:
    """Yield the writes of the configured module ident list (ETG.5001, object 0xF030)."""
    if not (plan.device.downloads_modules and plan.modules):
        return
    # As a list of PDOs: emptied first, and its length last, so that it is never half valid.
    yield SdoWrite(index=MODULE_LIST, data=b"\0", comment="modules")
    for subindex, ident in enumerate(plan.modules, 1):
        yield SdoWrite(index=MODULE_LIST, subindex=subindex, data=ident.to_bytes(4, "little"))
    yield SdoWrite(index=MODULE_LIST, data=bytes((len(plan.modules),)), comment="number of modules")


def _writes(device: EsiDevice) -> Iterator[SdoWrite | IdnWrite]:
    for each in device.init_commands:
        # Transitions of BOOT are those of a firmware update, not of a start.
        at = tuple(Transition(text) for text in each.transitions if text in set(Transition))
        if not at:
            continue
        if each.is_soe:
            yield IdnWrite(
                at=at, idn=each.index, data=each.data, drive=each.channel, comment=each.comment
            )
        else:
            yield SdoWrite(
                at=at,
                index=each.index,
                subindex=each.subindex,
                data=each.data,
                complete=each.complete_access,
                comment=each.comment,
            )
