"""Devices and modules of a file: elements turned into records (ETG.2000, Device and Module)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from devicebus.esi.fields import Fields, english, flag, is_true
from devicebus.esi.objects import read_objects
from devicebus.esi.records import (
    EsiAlternative,
    EsiCoe,
    EsiDevice,
    EsiEeprom,
    EsiFmmu,
    EsiInitCommand,
    EsiMailbox,
    EsiModule,
    EsiOpMode,
    EsiPdo,
    EsiPdoEntry,
    EsiSlot,
    EsiSyncManager,
    SmUse,
)
from eap.codec.xmlstream import XmlElement
from eap.od.slave_config import OpMode, RevisionRule, StateTimeouts

MAX_SYNC_MANAGERS = 16
MAX_PDOS = 4096
"""PDOs of one device or module."""
MAX_ENTRIES = 4096
MAX_ENTRY_BITS = 8 * 1486
"""Bits of an entry, which is at most a frame."""
MAX_SLOTS = 1024
_MAX_EEPROM = 1 << 20
_TRANSITIONS = frozenset(("IP", "PS", "SP", "SO", "OS", "OP", "PI", "SI", "OI", "IB", "BI", "II"))
_SIZES = ("MinSize", "DefaultSize", "MaxSize")


class EsiIdentity(NamedTuple):
    """Identity of a device, for lists of files too."""

    type: str
    """Type as it is printed on the device, EL2004."""
    product: int
    revision: int
    name: str


def identify(element: XmlElement, fields: Fields) -> EsiIdentity:
    """Return the identity of the device of *element*."""
    kind = element.find("Type")
    if kind is None:
        return EsiIdentity("", 0, 0, english(element))
    text = " ".join(kind.text.split())
    return EsiIdentity(
        text,
        fields.attribute(kind, "ProductCode"),
        fields.attribute(kind, "RevisionNo"),
        english(element) or text,
    )


def read_device(element: XmlElement, vendor: int, vendor_name: str, fields: Fields) -> EsiDevice:
    """Return the device of *element*, without modules; its faults go to *fields*."""
    own = identify(element, fields)
    kind = element.find("Type")
    managers = tuple(_sync_managers(element, fields))
    mailbox = element.find("Mailbox")
    slots = element.find("Slots")
    modes = element.find("Dc")
    return EsiDevice(
        vendor=vendor,
        vendor_name=vendor_name,
        product=own.product,
        revision=own.revision,
        revision_rule=_revision_rule(kind),
        type=own.type,
        name=own.name,
        group=element.findtext("GroupType"),
        physics=element.get("Physics"),
        sync_managers=managers,
        fmmus=tuple(_fmmus(element, fields)),
        pdos=tuple(_pdos(element, managers, fields)),
        mailbox=None if mailbox is None else _mailbox(mailbox, fields),
        init_commands=() if mailbox is None else tuple(_init_commands(mailbox, fields)),
        op_modes=() if modes is None else tuple(_op_modes(modes, fields)),
        has_dc=modes is not None,
        slots=() if slots is None else tuple(_slots(slots, fields)),
        downloads_modules=slots is not None and flag(slots, "DownloadModuleIdentList"),
        timeouts=_timeouts(element, fields),
        starts_without_sync=_flag_at(element, "Info/StateMachine/Behavior", "StartToSafeopNoSync"),
        # Negative for a device that feeds the E-bus, such as a coupler.
        ebus_ma=fields.child(element, "Info/Electrical/EBusCurrent", bits=16, is_signed=True),
        has_reg134_identification=is_true(element.findtext("Info/IdentificationReg134")),
        profile_number=fields.optional_child(element, "Profile/ProfileNo"),
        eeprom=_eeprom(element.find("Eeprom"), fields),
        alternatives=tuple(_alternatives(element, fields)),
        objects=read_objects(element, fields),
        dictionary_file=element.findtext("Profile/DictionaryFile"),
    )


def read_module(
    element: XmlElement, sync_managers: Sequence[EsiSyncManager], fields: Fields
) -> EsiModule:
    """Return the module of *element*."""
    kind = element.find("Type")
    mailbox = element.find("Mailbox")
    ident = 0
    module_class = name = ""
    if kind is None:
        fields.report(element.line, "a module has no Type", "element Type with ModuleIdent")
    else:
        ident = fields.attribute(kind, "ModuleIdent")
        module_class = kind.get("ModuleClass")
        name = " ".join(kind.text.split())
    return EsiModule(
        ident=ident,
        type=name,
        name=english(element) or name,
        module_class=module_class,
        pdos=tuple(_pdos(element, sync_managers, fields)),
        init_commands=() if mailbox is None else tuple(_init_commands(mailbox, fields)),
        objects=read_objects(element, fields),
    )


# Words of the revision number: the high one is the revision, the low one a special version.
_RULES = {
    "NONE": RevisionRule.ANY,
    "EQ": RevisionRule.EXACT,
    "EQ_OR_G": RevisionRule.AT_LEAST,
    "LW_EQ": RevisionRule.SAME_LOW,
    "LW_EQ_HW_EQ_OR_G": RevisionRule.SAME_LOW_AT_LEAST,
    "HW_EQ": RevisionRule.SAME_HIGH,
    "HW_EQ_LW_EQ_OR_G": RevisionRule.SAME_HIGH_AT_LEAST,
}


def _revision_rule(kind: XmlElement | None) -> RevisionRule | None:
    text = "" if kind is None else kind.get("CheckRevisionNo").upper()
    return _RULES.get(text)


def _sync_managers(device: XmlElement, fields: Fields) -> Iterator[EsiSyncManager]:
    found = list(device.iterfind("Sm"))
    if len(found) > MAX_SYNC_MANAGERS:
        fields.report(
            found[MAX_SYNC_MANAGERS].line,
            f"a device has {len(found)} sync managers",
            f"at most {MAX_SYNC_MANAGERS}",
        )
    for each in found[:MAX_SYNC_MANAGERS]:
        try:
            use = SmUse(each.text)
        except ValueError:
            known = ", ".join(SmUse)
            fields.report(each.line, f"sync manager with use {each.text[:40]!r}", f"one of {known}")
            # Kept, because PDOs refer to the sync managers behind it by their numbers.
            use = SmUse.INPUTS
        minimum, default, maximum = (
            fields.optional_attribute(each, name, bits=16) for name in _SIZES
        )
        yield EsiSyncManager(
            use=use,
            start=fields.attribute(each, "StartAddress", bits=16),
            default_size=default,
            min_size=minimum,
            max_size=maximum,
            control=fields.optional_attribute(each, "ControlByte", bits=8),
            # A number is the activate register (0x0806), whose bit 0 it is: a file has 9.
            is_enabled=bool(fields.attribute(each, "Enable", bits=8, default=1) & 1)
            if _is_numeric(each, "Enable")
            else flag(each, "Enable"),
            is_virtual=flag(each, "Virtual"),
            op_only=flag(each, "OpOnly"),
        )


def _is_numeric(element: XmlElement, name: str) -> bool:
    text = element.get(name).lower()
    return text not in {"true", "false"}


def _fmmus(device: XmlElement, fields: Fields) -> Iterator[EsiFmmu]:
    for each in device.iterfind("Fmmu"):
        manager = fields.optional_attribute(each, "Sm", bits=8)
        yield EsiFmmu(each.text, manager, flag(each, "OpOnly"))


def _pdos(
    parent: XmlElement, managers: Sequence[EsiSyncManager], fields: Fields
) -> Iterator[EsiPdo]:
    # In the order of the file: of PDOs that exclude each other the first one is the default.
    found = [each for each in parent.children if each.tag in {"RxPdo", "TxPdo"}]
    if len(found) > MAX_PDOS:
        message = f"{len(found)} PDOs"
        fields.report(found[MAX_PDOS].line, message, f"at most {MAX_PDOS}")
    for each in found[:MAX_PDOS]:
        yield _pdo(each, managers, fields)


def _pdo(each: XmlElement, managers: Sequence[EsiSyncManager], fields: Fields) -> EsiPdo:
    index_node = each.find("Index")
    index = fields.child(each, "Index", bits=16)
    if index_node is None or not index_node.text:
        missing = "refers to a group (Ref)" if "Ref" in each.attrib else "has no index"
        fields.report(each.line, f"a {each.tag} {missing}", "element Index with its object")
    manager = fields.optional_attribute(each, "Sm", bits=8)
    if manager is not None and manager >= len(managers):
        message = f"{each.tag} 0x{index:04X} is for sync manager {manager}"
        fields.report(each.line, message, f"one of the {len(managers)} sync managers of the device")
        manager = None
    elif manager is not None and managers[manager].is_output is not (each.tag == "RxPdo"):
        message = (
            f"{each.tag} 0x{index:04X} is for sync manager {manager} ({managers[manager].use})"
        )
        fields.report(each.line, message, "a sync manager of its direction")
    entries = [_entry(entry, fields) for entry in each.iterfind("Entry")]
    if len(entries) > MAX_ENTRIES:
        message = f"{each.tag} 0x{index:04X} has {len(entries)} entries"
        fields.report(each.line, message, f"at most {MAX_ENTRIES}")
        del entries[MAX_ENTRIES:]
    return EsiPdo(
        index=index,
        name=english(each),
        is_output=each.tag == "RxPdo",
        entries=tuple(entries),
        sync_manager=manager,
        is_fixed=flag(each, "Fixed"),
        is_mandatory=flag(each, "Mandatory"),
        is_virtual=flag(each, "Virtual"),
        excludes=tuple(
            fields.number(other.text, other.line, "Exclude", bits=16)
            for other in each.iterfind("Exclude")
        ),
        depends_on_slot=index_node is not None and flag(index_node, "DependOnSlot"),
        overwritten_by_module=flag(each, "OverwrittenByModule"),
        line=each.line,
    )


def _entry(entry: XmlElement, fields: Fields) -> EsiPdoEntry:
    index = entry.find("Index")
    bits = fields.child(entry, "BitLen", bits=16)
    if bits > MAX_ENTRY_BITS:
        fields.report(entry.line, f"an entry has {bits} bits", f"at most {MAX_ENTRY_BITS}")
        bits = 0
    return EsiPdoEntry(
        index=fields.child(entry, "Index", bits=16),
        subindex=fields.child(entry, "SubIndex", bits=8),
        bits=bits,
        name=english(entry),
        type=entry.findtext("DataType"),
        is_fixed=flag(entry, "Fixed"),
        depends_on_slot=index is not None and flag(index, "DependOnSlot"),
    )


def _mailbox(mailbox: XmlElement, fields: Fields) -> EsiMailbox:
    coe, soe = mailbox.find("CoE"), mailbox.find("SoE")
    return EsiMailbox(
        coe=None if coe is None else _coe(coe),
        soe_channels=0
        if soe is None
        else max(1, fields.attribute(soe, "ChannelCount", bits=8, default=1)),
        aoe=mailbox.find("AoE") is not None,
        eoe=mailbox.find("EoE") is not None,
        foe=mailbox.find("FoE") is not None,
        voe=mailbox.find("VoE") is not None,
        has_link_layer=flag(mailbox, "DataLinkLayer"),
    )


def _coe(coe: XmlElement) -> EsiCoe:
    return EsiCoe(
        sdo_info=flag(coe, "SdoInfo"),
        pdo_assign=flag(coe, "PdoAssign"),
        pdo_config=flag(coe, "PdoConfig"),
        pdo_upload=flag(coe, "PdoUpload"),
        complete_access=flag(coe, "CompleteAccess"),
        # Hardly a file has it: its absence cannot mean that a device refuses segments.
        segmented_sdo="SegmentedSdo" not in coe.attrib or flag(coe, "SegmentedSdo"),
        diagnosis_history=flag(coe, "DiagHistory"),
    )


def _init_commands(mailbox: XmlElement, fields: Fields) -> Iterator[EsiInitCommand]:
    for protocol, place in (("CoE", "Index"), ("SoE", "IDN")):
        parent = mailbox.find(protocol)
        for each in () if parent is None else parent.iterfind("InitCmd"):
            command = _init_command(each, place, fields)
            if command is not None:
                yield command


def _init_command(each: XmlElement, place: str, fields: Fields) -> EsiInitCommand | None:
    transitions = tuple(node.text.upper() for node in each.iterfind("Transition"))
    index = each.find(place)
    wrong = [text for text in transitions if text not in _TRANSITIONS]
    if wrong or not transitions:
        message = f"an InitCmd is for transition {', '.join(wrong)[:40] or 'none'}"
        fields.report(each.line, message, "such as IP, PS or SO")
        return None
    if index is None:
        fields.report(each.line, "an InitCmd writes nothing", f"element {place}")
        return None
    data = each.find("Data")
    return EsiInitCommand(
        transitions=transitions,
        index=fields.child(each, place, bits=16),
        subindex=fields.child(each, "SubIndex", bits=8),
        channel=fields.attribute(each, "Chn", bits=8),
        data=fields.octets(data, "Data of an InitCmd"),
        is_soe=place == "IDN",
        complete_access=flag(each, "CompleteAccess"),
        is_fixed=flag(each, "Fixed"),
        is_adapted=data is not None and flag(data, "AdaptAutomatically"),
        overwritten_by_module=flag(each, "OverwrittenByModule"),
        depends_on_slot=flag(index, "DependOnSlot"),
        comment=english(each, "Comment"),
    )


def _op_modes(modes: XmlElement, fields: Fields) -> Iterator[EsiOpMode]:
    for each in modes.iterfind("OpMode"):
        mode = OpMode(
            name=each.findtext("Name"),
            activate=fields.child(each, "AssignActivate", bits=16),
            # A time of 0 is that of the bus cycle, times the factor.
            cycle0_ns=fields.child(each, "CycleTimeSync0"),
            factor0=_factor(each, "CycleTimeSync0", 1, fields),
            shift0_ns=fields.child(each, "ShiftTimeSync0", is_signed=True),
            shift0_factor=_factor(each, "ShiftTimeSync0", 0, fields),
            cycle1_ns=fields.child(each, "CycleTimeSync1"),
            factor1=_factor(each, "CycleTimeSync1", 0, fields),
            shift1_ns=fields.child(each, "ShiftTimeSync1", is_signed=True),
        )
        yield EsiOpMode(mode=mode, description=english(each, "Desc"))


def _factor(mode: XmlElement, tag: str, default: int, fields: Fields) -> int:
    element = mode.find(tag)
    text = "" if element is None else element.get("Factor")
    if element is None or not text:
        return default
    return fields.number(text, element.line, f"{tag} Factor", bits=16, is_signed=True)


def _assignments(parent: XmlElement, fields: Fields) -> Iterator[tuple[int, tuple[int, ...]]]:
    """Yield the PDOs of each sync manager of an alternative."""
    for each in parent.iterfind("Sm"):
        pdos = tuple(
            fields.number(pdo.text, pdo.line, "Pdo", bits=16)
            for pdo in each.iterfind("Pdo")
            if pdo.text
        )
        if pdos:
            yield fields.attribute(each, "No", bits=8), pdos


def _slots(slots: XmlElement, fields: Fields) -> Iterator[EsiSlot]:
    pdo_step = fields.attribute(slots, "SlotPdoIncrement", bits=16)
    index_step = fields.attribute(slots, "SlotIndexIncrement", bits=16)
    found = list(slots.iterfind("Slot"))
    if len(found) > MAX_SLOTS:
        fields.report(slots.line, f"{len(found)} slots", f"at most {MAX_SLOTS}")
    for each in found[:MAX_SLOTS]:
        default = None
        idents = []
        for node in each.iterfind("ModuleIdent"):
            idents.append(fields.number(node.text, node.line, "ModuleIdent"))
            if flag(node, "Default"):
                default = idents[-1]
        yield EsiSlot(
            name=english(each),
            idents=tuple(idents),
            classes=tuple(node.findtext("Class") for node in each.iterfind("ModuleClass")),
            default=default,
            min_instances=fields.attribute(each, "MinInstances", bits=16),
            max_instances=fields.attribute(each, "MaxInstances", bits=16, default=1),
            pdo_step=fields.attribute(each, "SlotPdoIncrement", bits=16, default=pdo_step),
            index_step=fields.attribute(each, "SlotIndexIncrement", bits=16, default=index_step),
        )


def _timeouts(device: XmlElement, fields: Fields) -> StateTimeouts:
    states = "Info/StateMachine/Timeout"
    return StateTimeouts(
        preop_ms=fields.optional_child(device, f"{states}/PreopTimeout"),
        safeop_op_ms=fields.optional_child(device, f"{states}/SafeopOpTimeout"),
        back_to_init_ms=fields.optional_child(device, f"{states}/BackToInitTimeout"),
        back_to_safeop_ms=fields.optional_child(device, f"{states}/BackToSafeopTimeout"),
        response_ms=fields.optional_child(device, "Info/Mailbox/Timeout/ResponseTimeout"),
    )


def _eeprom(eeprom: XmlElement | None, fields: Fields) -> EsiEeprom:
    if eeprom is None:
        return EsiEeprom()
    size = fields.child(eeprom, "ByteSize")
    if size > _MAX_EEPROM:
        fields.report(eeprom.line, f"an EEPROM of {size} bytes", f"at most {_MAX_EEPROM}")
        size = 0
    return EsiEeprom(
        byte_size=size,
        # Words 0 to 6 of the SII; word 7 is their checksum, which is computed.
        config_data=fields.octets(eeprom.find("ConfigData"), "ConfigData")[:14],
        bootstrap=fields.octets(eeprom.find("BootStrap"), "BootStrap"),
        image=fields.octets(eeprom.find("Data"), "Data"),
        categories=tuple(_categories(eeprom.iterfind("Category"), fields)),
    )


def _categories(found: Iterable[XmlElement], fields: Fields) -> Iterator[tuple[int, bytes]]:
    for each in found:
        number = fields.child(each, "CatNo", bits=16)
        text = each.find("DataString")
        if text is not None:
            yield number, text.text.encode("latin-1", "replace")
        elif each.find("Data") is not None:
            yield number, fields.octets(each.find("Data"), "Data of a category")
        elif each.find("DataUINT") is not None:
            yield number, fields.child(each, "DataUINT", bits=16).to_bytes(2, "little")
        else:
            yield number, fields.child(each, "DataUDINT").to_bytes(4, "little")


def _alternatives(device: XmlElement, fields: Fields) -> Iterator[EsiAlternative]:
    # Found below the device, and in newer files below its element Info.
    for path in ("VendorSpecific/TwinCAT", "Info/VendorSpecific/TwinCAT"):
        parent = device.find(path)
        for each in () if parent is None else parent.iterfind("AlternativeSmMapping"):
            yield EsiAlternative(
                name=english(each),
                is_default=flag(each, "Default"),
                sync_managers=tuple(_assignments(each, fields)),
            )


def _flag_at(parent: XmlElement, path: str, name: str) -> bool:
    found = parent.find(path)
    return found is not None and flag(found, name)
