"""Configuration of slaves by the keys of bus files and plant files, and its checks.

The description of a slave has the PDOs, objects and operation modes that the keys name; the result
is the description with another configuration and other process data.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from msgspec.structs import replace

from eap.codec import datatypes
from eap.codec.soe import CONTROL_WORD, STATUS_WORD, Idn
from eap.config.finding import FindingReport, one_of
from eap.config.index import DescribedPdo, DescribedPdoEntry, DescribedSlave, plain_name
from eap.config.structs import SlaveSection, StartupSection
from eap.ids import ObjectId
from eap.od.model import RW, WO, OdState
from eap.od.slave_config import (
    ALIAS_REGISTER,
    BY_SERIAL,
    ID_REGISTER,
    US,
    IdnWrite,
    MappedObject,
    OpMode,
    SdoWrite,
    SlaveConfig,
    Transition,
)
from eap.suggest import suggest

_IDENTIFICATIONS = {"alias": ALIAS_REGISTER, "id": ID_REGISTER, "serial": BY_SERIAL}
_MAX_ENTRY_BITS = 0xFF
_SDO = "an object as INDEX:SUB in hexadecimal, such as 0x8000:01"
_ENTRY = "the name of an entry, INDEX:SUB, INDEX:SUB/BITS, or 0/BITS for padding"
_DATA = "hexadecimal bytes, least significant first, such as 0a 00"
_SYNC0_BIT, _SYNC1_BIT = 0x0200, 0x0400
_CYCLIC_BIT = 0x0100
_TIMES = 1 << 32
"""Times in nanoseconds are 32 bits in the registers."""
_MAX_ENTRIES = 254
_STATES = {"P": OdState.PREOP, "S": OdState.SAFEOP, "O": OdState.OP}
_MANAGERS = {str(number): number for number in range(16)}


class _BadKeyError(Exception):
    """A key was reported and cannot be used."""


def configure(slave: DescribedSlave, keys: SlaveSection, report: FindingReport) -> DescribedSlave:
    """Return *slave* with its configuration changed by *keys*; what is wrong goes to *report*.

    A key replaces what the description, or the bus file, has for it; start-up writes are added.
    """
    config = slave.config
    given = {
        name: value
        for name in ("optional", "group", "revision_rule", "timeouts")
        if (value := getattr(keys, name)) is not None
    }
    if keys.watchdog is not None:
        given["watchdogs"] = keys.watchdog
    config = replace(config, **given)
    if keys.identification is not None:
        config = _identified(config, keys, report)
    config = _assigned(slave, config, keys, report)
    config = _mapped(slave, config, keys, report)
    config = replace(config, writes=_writes(slave, config, keys, report))
    config = _synchronized(slave, config, keys, report)
    identity = {
        name: value
        for name in ("revision", "serial", "alias")
        if (value := getattr(keys, name)) is not None
    }
    outputs, inputs = process_data(slave, config)
    return replace(slave, config=config, outputs=outputs, inputs=inputs, **identity)


def process_data(
    slave: DescribedSlave, config: SlaveConfig
) -> tuple[tuple[DescribedPdoEntry, ...], tuple[DescribedPdoEntry, ...]]:
    """Return outputs and inputs of *slave* with the PDOs of *config*."""
    if not config.assignment and not config.mapping:
        return slave.outputs, slave.inputs
    assigned = {**default_assignment(slave), **config.assignment}
    known = {pdo.index: pdo for pdo in slave.pdos}
    sides: tuple[list[DescribedPdoEntry], list[DescribedPdoEntry]] = ([], [])
    for manager, pdos in sorted(assigned.items()):
        for index in pdos:
            if index not in known:
                continue  # a finding of its own
            pdo = known[index]
            entries: Iterable[DescribedPdoEntry] = pdo.entries
            if index in config.mapping:
                entries = [_described(slave, each) for each in config.mapping[index]]
            side = sides[0 if pdo.is_output else 1]
            side += [replace(each, manager=manager, group=pdo.group) for each in entries]
    return tuple(sides[0]), tuple(sides[1])


def default_assignment(slave: DescribedSlave) -> dict[int, tuple[int, ...]]:
    """Return the PDOs that a slave has without a configuration, by sync manager."""
    assigned: dict[int, tuple[int, ...]] = {}
    for pdo in slave.pdos:
        if pdo.assigned:
            assigned[pdo.manager] = (*assigned.get(pdo.manager, ()), pdo.index)
    return assigned


def check_cycles(
    slaves: Mapping[str, DescribedSlave], cycle_us: int, report: FindingReport, at: str
) -> None:
    """Report slaves whose SYNC0 does not fit the cycle of the bus; *at* is the section of it."""
    cycle_ns = cycle_us * US
    for name, slave in slaves.items():
        mode = slave.config.sync
        signals = None if mode is None else mode.signals(cycle_ns)
        if signals is None:
            continue
        times = (
            ("SYNC0 every", signals.cycle0_ns),
            ("SYNC1 after", signals.cycle1_ns),
            ("SYNC0 shifted by", abs(signals.shift0_ns)),
        )
        wrong = [f"{what} {time / US:g} µs" for what, time in times if not 0 <= time < _TIMES]
        for text in wrong:
            message = f"{name}: {text} does not fit the register"
            report.add(f"{at}.slaves.{name}.sync0", message, "0 to 4294967 µs")
        if wrong:
            continue
        sync0 = signals.cycle0_ns
        if sync0 % cycle_ns and cycle_ns % sync0:
            report.add(
                f"{at}.slaves.{name}.sync0",
                f"{name}: SYNC0 every {sync0 / US:g} µs does not fit the cycle of {cycle_us} µs",
                "a multiple of the cycle, or a cycle that is a multiple of it",
            )


def _identified(config: SlaveConfig, keys: SlaveSection, report: FindingReport) -> SlaveConfig:
    text = str(keys.identification)
    register = _IDENTIFICATIONS.get(text)
    if register is None:
        try:
            register = int(text, 0)
        except ValueError:
            register = -1
        if not 0 < register <= 0xFFF:
            message = f"identification {text!r}{suggest(text, _IDENTIFICATIONS)}"
            expected = f"{one_of(_IDENTIFICATIONS)}, or a register"
            report.add(f"{keys.at}.identification", message, expected)
            return config
    return replace(config, identification=register)


def _assigned(
    slave: DescribedSlave, config: SlaveConfig, keys: SlaveSection, report: FindingReport
) -> SlaveConfig:
    """Return *config* with the PDOs of the key ``pdos``."""
    if keys.pdos is None:
        return config
    assignment = dict(config.assignment)
    at = f"{keys.at}.pdos"
    if isinstance(keys.pdos, dict):
        for text, names in keys.pdos.items():
            manager = _MANAGERS.get(text)
            if manager is None:
                report.add(f"{at}.{text}", f"{text!r} is no sync manager", "a number from 0 to 15")
                continue
            pdos = list(_pdos(slave, names, report, f"{at}.{text}"))
            assignment[manager] = tuple(each.index for each in pdos)
    elif len(keys.pdos) == 1 and keys.pdos[0] in slave.assignments:
        assignment |= slave.assignments[keys.pdos[0]]
    else:
        chosen = list(_pdos(slave, keys.pdos, report, at))
        # A list replaces the PDOs of each direction of which it names one.
        sides = {each.is_output for each in chosen}
        for pdo in slave.pdos:
            if pdo.is_output in sides and pdo.assigned:
                assignment[pdo.manager] = ()
        for each in chosen:
            assignment[each.manager] = (*assignment.get(each.manager, ()), each.index)
    _check_assignment(slave, assignment, report, at)
    # Without CoE the length of a sync manager chooses its PDOs: no object has to be written.
    usual = default_assignment(slave)
    is_other = any(pdos != usual.get(number, ()) for number, pdos in assignment.items())
    if config.fixed_pdos and slave.has_coe and is_other:
        message = f"{slave.name}: its PDO assignment is fixed"
        report.add(at, message, "its default PDOs: its description has no PdoAssign")
    return replace(config, assignment=assignment)


def _pdos(
    slave: DescribedSlave, names: Iterable[str], report: FindingReport, at: str
) -> Iterator[DescribedPdo]:
    for position, text in enumerate(names):
        found = _find_pdo(slave, text)
        if found is None:
            known = [each.label for each in slave.pdos]
            message = f"{slave.name} has no PDO {text!r}{suggest(text, _names(slave))}"
            report.add(f"{at}[{position}]", message, one_of(known) if known else "no PDOs")
        else:
            yield found


def _names(slave: DescribedSlave) -> list[str]:
    return [*slave.assignments, *(each.name for each in slave.pdos if each.name)]


def _find_pdo(slave: DescribedSlave, text: str) -> DescribedPdo | None:
    """Return the PDO with that name or index."""
    try:
        index = int(text, 0)
    except ValueError:
        index = -1
    return next((each for each in slave.pdos if each.index == index or each.name == text), None)


def _check_assignment(
    slave: DescribedSlave,
    assignment: Mapping[int, tuple[int, ...]],
    report: FindingReport,
    at: str,
) -> None:
    """Report PDOs that exclude each other, missing ones, and those in a wrong direction."""
    known = {each.index: each for each in slave.pdos}
    chosen = {index: manager for manager, pdos in assignment.items() for index in pdos}
    all_chosen = [index for pdos in assignment.values() for index in pdos]
    for index in dict.fromkeys(all_chosen):
        if all_chosen.count(index) > 1:
            report.add(at, f"{slave.name}: PDO 0x{index:04X} is assigned twice", "each PDO once")
    for index, manager in chosen.items():
        pdo = known[index]
        for other in sorted(chosen.keys() & set(pdo.excludes)):
            report.add(
                at,
                f"{slave.name}: PDO {pdo.label} excludes {known[other].label}",
                "one of them",
            )
        direction = slave.managers.get(manager, pdo.is_output)
        if direction is not pdo.is_output:
            report.add(
                at,
                f"{slave.name}: PDO {pdo.label} is {'an output' if pdo.is_output else 'an input'},"
                f" sync manager {manager} has {'outputs' if direction else 'inputs'}",
                f"sync manager {pdo.manager}",
            )
    for pdo in slave.pdos:
        if pdo.mandatory and pdo.manager in assignment and pdo.index not in chosen:
            report.add(
                at,
                f"{slave.name}: PDO {pdo.label} is mandatory, but not assigned",
                f"{pdo.label} in the list",
            )


def _mapped(
    slave: DescribedSlave, config: SlaveConfig, keys: SlaveSection, report: FindingReport
) -> SlaveConfig:
    """Return *config* with the entries of the key ``mapping``."""
    if keys.mapping is None:
        return config
    mapping = dict(config.mapping)
    assignment = dict(config.assignment)
    for text, entries in keys.mapping.items():
        at = f"{keys.at}.mapping.{text}"
        for pdo in _pdos(slave, [text], report, at):
            if pdo.fixed:
                message = f"{slave.name}: the mapping of PDO {pdo.label} is fixed"
                report.add(at, message, "a PDO whose entries can be chosen")
                continue
            # A slave lets a PDO be changed only while it is not assigned.
            assigned = default_assignment(slave).get(pdo.manager, ())
            assignment.setdefault(pdo.manager, assigned)
            if len(entries) > _MAX_ENTRIES:
                message = f"{slave.name}: {len(entries)} entries in PDO {pdo.label}"
                report.add(at, message, f"at most {_MAX_ENTRIES}")
                continue
            found = tuple(_entries(slave, pdo, entries, report, at))
            mapping[pdo.index] = (*_fixed_word(pdo, found), *found)
    return replace(config, mapping=mapping, assignment=assignment)


def _entries(
    slave: DescribedSlave, pdo: DescribedPdo, texts: Iterable[str], report: FindingReport, at: str
) -> Iterator[MappedObject]:
    for position, text in enumerate(texts):
        entry = _find_entry(slave, pdo, text)
        if entry is None:
            hint = suggest(text, [plain_name(each) for each in _known_entries(slave).values()])
            message = f"{slave.name}: {text!r} cannot be mapped{hint}"
            report.add(f"{at}[{position}]", message, _ENTRY)
        else:
            yield entry


def _find_entry(slave: DescribedSlave, pdo: DescribedPdo, text: str) -> MappedObject | None:
    """Return the entry that *text* means; None if there is none, or its length is not known."""
    same_side = [e for each in slave.pdos if each.is_output is pdo.is_output for e in each.entries]
    for each in (*same_side, *slave.objects):
        if each.index and text in {each.name, plain_name(each)}:
            return MappedObject(each.index, each.subindex, each.bit_length)
    place, slash, bits_text = text.partition("/")
    try:
        number = _object_id(place.strip())
        bits = int(bits_text) if slash else _bit_length(slave, number)
    except ValueError:
        return None
    if not 0 < bits <= _MAX_ENTRY_BITS:
        return None
    return MappedObject(number.object_index, number.subindex, bits)


def _object_id(text: str) -> ObjectId:
    """Return an entry as an object or as an IDN; raise ValueError if it is neither."""
    return ObjectId(Idn.parse(text).number) if text[1:2] == "-" else ObjectId.parse(text)


def _fixed_word(pdo: DescribedPdo, entries: Iterable[MappedObject]) -> Iterator[MappedObject]:
    """Yield the first entry of a telegram (SoE), which no list can leave out."""
    for first in pdo.entries[:1]:
        if first.index in {CONTROL_WORD, STATUS_WORD} and all(
            each.index != first.index for each in entries
        ):
            yield MappedObject(first.index, first.subindex, first.bit_length)


def _bit_length(slave: DescribedSlave, number: ObjectId) -> int:
    known = _known_entries(slave).get((number.object_index, number.subindex))
    return known.bit_length if known is not None else 0


def _known_entries(slave: DescribedSlave) -> dict[tuple[int, int], DescribedPdoEntry]:
    entries = [*slave.objects, *(entry for pdo in slave.pdos for entry in pdo.entries)]
    return {(each.index, each.subindex): each for each in entries if each.index}


def _described(slave: DescribedSlave, mapped: MappedObject) -> DescribedPdoEntry:
    """Return a mapped entry with the name and type that the description knows."""
    place = mapped.index, mapped.subindex
    known = _known_entries(slave).get(place)
    bits = mapped.bit_length
    if known is not None and known.bit_length == bits:
        return known
    kind = datatypes.untyped(bits) or f"BLOCK({bits // 8})"
    if not mapped.index or (bits > 8 and bits % 8):
        kind = ""
    return DescribedPdoEntry("" if known is None else known.name, kind, *place, bits)


def _writes(
    slave: DescribedSlave, config: SlaveConfig, keys: SlaveSection, report: FindingReport
) -> tuple[SdoWrite | IdnWrite, ...]:
    """Return the writes of *config* and of *keys*; one of the same object and transitions replaces.

    Order counts: a replaced write keeps its place.
    """
    found = list(config.writes)
    for section in keys.startup:
        try:
            write = _write(slave, section, report)
        except _BadKeyError:
            continue
        for number, each in enumerate(found):
            if _same_target(each, write):
                found[number] = write
                break
        else:
            found.append(write)
    return tuple(found)


def _same_target(one: SdoWrite | IdnWrite, other: SdoWrite | IdnWrite) -> bool:
    empty = {"data": b"", "comment": ""}
    return type(one) is type(other) and replace(one, **empty) == replace(other, **empty)


def _write(
    slave: DescribedSlave, section: StartupSection, report: FindingReport
) -> SdoWrite | IdnWrite:
    given = section.transition
    transitions = given if isinstance(given, tuple) else (given,)
    at = tuple(_transition(each, section, report) for each in transitions)
    if bool(section.sdo) is bool(section.idn):
        report.add(section.at, "start-up write without a target", "one of sdo and idn")
        raise _BadKeyError
    if section.sdo:
        return _sdo_write(slave, section, at, report)
    if not slave.has_soe:
        message = f"{slave.name} has no mailbox with SoE for {section.idn}"
        report.add(f"{section.at}.idn", message, "an SDO, or a slave with SoE")
    try:
        idn = Idn.parse(section.idn).number
    except ValueError as exc:
        report.add(f"{section.at}.idn", str(exc), "an IDN such as S-0-0032")
        raise _BadKeyError from None
    data = _data(slave, section, None, report)
    return IdnWrite(at=at, idn=idn, data=data, drive=section.drive, comment=section.comment)


def _transition(text: str, section: StartupSection, report: FindingReport) -> Transition:
    try:
        return Transition(text)
    except ValueError:
        report.add(f"{section.at}.transition", f"{text!r} is no transition", one_of(Transition))
        raise _BadKeyError from None


def _sdo_write(
    slave: DescribedSlave,
    section: StartupSection,
    at: tuple[Transition, ...],
    report: FindingReport,
) -> SdoWrite:
    try:
        place = ObjectId.parse(section.sdo)
    except ValueError as exc:
        report.add(f"{section.at}.sdo", str(exc), _SDO)
        raise _BadKeyError from None
    if not slave.has_coe:
        message = f"{slave.name} has no mailbox with CoE for {place}"
        report.add(f"{section.at}.sdo", message, "a slave with CoE")
    if section.complete and place.subindex > 1:
        message = f"complete access to {place}"
        report.add(f"{section.at}.sdo", message, "subindex 0 or 1 with complete access")
    known = _known_entries(slave).get((place.object_index, place.subindex))
    data = _data(slave, section, None if section.complete else known, report)
    if not section.complete:
        _check_access(slave, place, at, section, report)
    return SdoWrite(
        at=at,
        index=place.object_index,
        subindex=place.subindex,
        data=data,
        complete=section.complete,
        comment=section.comment,
    )


def _check_access(
    slave: DescribedSlave,
    place: ObjectId,
    at: tuple[Transition, ...],
    section: StartupSection,
    report: FindingReport,
) -> None:
    """Warn of an object without the right to write it: descriptions are not always right."""
    # Not those of PDOs: a mapped entry has no rights in its description.
    key = place.object_index, place.subindex
    access = next((each.access for each in slave.objects if (each.index, each.subindex) == key), RW)
    for transition in at:
        # A write of IP is sent in PREOP, because INIT has no mailbox.
        state = _STATES.get(transition[0], OdState.PREOP)
        if not access & state.write_right:
            where = f" in {state.name}" if access & WO else ""
            message = f"{place} of {slave.name} is read-only{where} by its description"
            expected = "an object that can be written, otherwise the slave may stay in"
            report.warn(section.at, message, f"{expected} {state.name}")
            return


def _data(
    slave: DescribedSlave,
    section: StartupSection,
    known: DescribedPdoEntry | None,
    report: FindingReport,
) -> bytes:
    """Return the bytes to write, checked against the *known* entry."""
    target = section.sdo or section.idn
    if (section.value is None) is (not section.data):
        report.add(section.at, f"start-up write of {target} without data", "one of value and data")
        raise _BadKeyError
    if section.data:
        data = _bytes_of(section, report)
    else:
        kind_text = section.type or (known.type if known is not None else "")
        if not kind_text:
            message = f"the type of {target} of {slave.name} is not known"
            report.add(f"{section.at}.value", message, "the key type, such as UINT, or data")
            raise _BadKeyError
        key = "type" if section.type else "value"
        try:
            kind = datatypes.parse(kind_text)
            key = "value"
            data = kind.encode(kind.from_plain(section.value))
        except ValueError as exc:
            usual = f"a value of {kind_text}" if key == "value" else "a data type"
            report.add_error(f"{section.at}.{key}", f"{target} of {slave.name}", exc, usual)
            raise _BadKeyError from None
    size = 0 if known is None else (known.bit_length + 7) // 8
    is_text = known is not None and known.type.startswith("STRING")
    if size and len(data) != size and not is_text:
        message = f"{target} of {slave.name}: {len(data)} bytes of data"
        report.add(section.at, message, f"{size} bytes")
        raise _BadKeyError
    return data


def _bytes_of(section: StartupSection, report: FindingReport) -> bytes:
    try:
        return bytes.fromhex(section.data.removeprefix("0x"))
    except ValueError:
        report.add(f"{section.at}.data", f"data {section.data!r}", _DATA)
        raise _BadKeyError from None


def _synchronized(
    slave: DescribedSlave, config: SlaveConfig, keys: SlaveSection, report: FindingReport
) -> SlaveConfig:
    """Return *config* with the SYNC0 and SYNC1 of *keys*."""
    mode = config.sync
    if keys.dc is not None:
        modes = {each.name: each for each in slave.op_modes}
        if keys.dc not in modes:
            hint = suggest(keys.dc, modes)
            known = one_of(modes) if modes else "sync0: its description has no operation modes"
            report.add(f"{keys.at}.dc", f"{slave.name} has no mode {keys.dc!r}{hint}", known)
            return config
        mode = modes[keys.dc]
    activate = mode.activate if mode is not None else 0
    changes: dict[str, int] = {}
    for key, section, bit in (
        ("0", keys.sync0, _SYNC0_BIT),
        ("1", keys.sync1, _SYNC1_BIT),
    ):
        if section is not None:
            activate |= _CYCLIC_BIT | bit
            changes[f"shift{key}_ns"] = round(section.shift_us * US)
            if section.cycle_us is not None:
                changes[f"cycle{key}_ns"] = section.cycle_us * US
    if changes and not activate & _SYNC0_BIT:
        report.add(f"{keys.at}.sync1", f"{slave.name}: SYNC1 without SYNC0", "sync0 beside sync1")
    if keys.activate is not None:
        activate = keys.activate
    if not changes and keys.activate is None:
        return replace(config, sync=mode)
    if not slave.has_clock:
        key = "sync0" if keys.sync0 is not None else "activate"
        message = f"{slave.name} has no distributed clock"
        report.add(f"{keys.at}.{key}", message, "no SYNC0 and SYNC1 for this slave")
    mode = replace(mode or OpMode(), activate=activate, **changes)
    return replace(config, sync=mode)


def override(
    slaves: Iterable[DescribedSlave],
    sections: Mapping[str, SlaveSection],
    report: FindingReport,
    at: str,
) -> tuple[DescribedSlave, ...]:
    """Return the slaves of a bus file with the keys that a plant file has for some of them."""
    described = tuple(slaves)
    names = [each.name for each in described]
    for name in sections:
        if name not in names:
            message = f"unknown slave {name!r}{suggest(name, names)}"
            expected = one_of(names) if names else "a bus file that describes the slaves"
            report.add(f"{at}.{name}", message, expected)
    return tuple(
        configure(each, sections[each.name], report) if each.name in sections else each
        for each in described
    )
