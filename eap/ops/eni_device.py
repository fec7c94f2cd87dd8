"""ESI description of a slave, made of what an ENI file says of it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from types import MappingProxyType
from xml.sax.saxutils import escape, quoteattr

from eap.codec.xmlstream import XmlElement
from eap.config.imports.eni_records import EniSlave, EniSyncManager, EniVariable
from eap.config.imports.records import ImportOutcome, ImportReport
from eap.od.slave_config import IdnWrite, SdoWrite

_NO_KEYS: Mapping[str, str] = MappingProxyType({})
_TYPES = {1: "USINT", 2: "UINT", 4: "UDINT", 8: "ULINT"}
_FIRST_PDO = {True: 0x1600, False: 0x1A00}
_FIRST_OBJECT = {True: 0x7000, False: 0x6000}
_MAX_SUBINDEX = 254
_ALIGNMENT = 0x100
_FIRST_AREA = 0x1000
_EEPROM = 2048
_LINE = 200
"""Characters of an element that is written in one line."""
_SYSTEM = ("WcState.", "InfoData.")
"""Beginnings of variables of TwinCAT that are no process data."""


def pdo_bits(pdo: XmlElement) -> tuple[int, int]:
    """Return index and bits of an element RxPdo or TxPdo."""
    return (
        pdo.number_at("Index", 0, 0xFFFF),
        sum(each.number_at("BitLen", 0, 0xFFFF) for each in pdo.iterfind("Entry")),
    )


def _node(
    tag: str,
    text: str = "",
    /,
    *children: XmlElement,
    line: int = 0,
    keys: Mapping[str, str] = _NO_KEYS,
) -> XmlElement:
    element = XmlElement(tag, dict(keys), line)
    element.text = text
    element.children = list(children)
    return element


class OwnDevice:
    """Description of one slave, as an element Device of an ESI file."""

    def __init__(
        self, eni: EniSlave, variables: list[EniVariable], report: ImportReport, file: str
    ) -> None:
        self._eni = eni
        self._variables = variables
        self._report = report
        self._file = file
        self._managers = dict(eni.managers)
        self._pdos: dict[int, XmlElement] = {}
        """By index, with the number of their sync manager as attribute."""

    def element(self) -> XmlElement:
        """Return the description; its elements have the lines of the ENI file."""
        eni = self._eni
        self._add_managers()
        self._take_pdos()
        identity = {
            "ProductCode": f"#x{eni.product:08X}",
            "RevisionNo": f"#x{eni.revision:08X}",
        }
        kind = _node("Type", line=eni.line, keys=identity)
        parts = [
            kind,
            _node("Name", eni.type or f"Product 0x{eni.product:08X}", keys={"LcId": "1033"}),
        ]
        if dictionary := self._dictionary():
            parts.append(_node("Profile", "", dictionary))
        parts += self._fmmus()
        parts += self._sync_managers()
        parts += self._pdos.values()
        if any(each.is_mailbox for each in self._managers.values()):
            parts.append(self._mailbox())
        if eni.has_clock:
            parts.append(_node("Dc"))
        eeprom = [_node("ByteSize", str(_EEPROM)), _node("ConfigData", "05080344")]
        if any(eni.bootstrap):
            eeprom.append(_node("BootStrap", eni.bootstrap.hex()))
        parts.append(_node("Eeprom", "", *eeprom))
        return _node("Device", "", *parts, line=eni.line)

    def _warn(self, message: str) -> None:
        self._report.note(
            self._file, self._eni.line, self._eni.name, ImportOutcome.WARNING, message
        )

    def _add_managers(self) -> None:
        """Add sync managers for process data of which the file has the size only."""
        found = self._managers
        mailboxes = [each for each in found.values() if each.is_mailbox]
        used = {each.is_output for each in found.values() if not each.is_mailbox}
        end = max((each.start + each.size for each in mailboxes), default=_FIRST_AREA)
        start = -(-end // _ALIGNMENT) * _ALIGNMENT
        sides = ((True, self._eni.output_bits), (False, self._eni.input_bits))
        for is_output, bits in sides:
            if bits and is_output not in used:
                first = 2 if mailboxes else 0
                number = next(each for each in range(first, 64) if each not in found)
                found[number] = EniSyncManager(
                    start=start, control=0x64 if is_output else 0x20, is_output=is_output, bits=bits
                )
                start += 2 * _ALIGNMENT
                self._warn("its sync managers are not in the file: addresses are made up")

    def _take_pdos(self) -> None:
        listed: dict[int, XmlElement] = {}
        for pdo in self._eni.pdos:
            index = pdo.number_at("Index", 0, 0xFFFF)
            listed.setdefault(index, pdo)
        owners = {
            index: number for number, each in self._managers.items() for index in each.pdos or ()
        }
        # The order of the lists is that of the process data.
        for index in dict.fromkeys((*owners, *listed)):
            if index in listed:
                self._pdos[index] = self._copied(listed[index], index, owners.get(index))
            elif index in self._eni.mapping:
                self._pdos[index] = self._mapped(index, owners[index])
        for number, manager in self._managers.items():
            if not manager.is_mailbox:
                self._complete(number, manager)

    def _copied(self, pdo: XmlElement, index: int, owner: int | None) -> XmlElement:
        keys = {name: value for name, value in pdo.attrib.items() if name in {"Fixed", "Mandatory"}}
        if index in self._eni.mapping:
            keys.pop("Fixed", None)
        known = any(each.pdos is not None for each in self._managers.values())
        if owner is not None:
            keys["Sm"] = str(owner)
        elif not known and pdo.get("Sm"):
            keys["Sm"] = pdo.get("Sm")
        else:
            keys.pop("Mandatory", None)
        copied = _node(pdo.tag, "", line=pdo.line, keys=keys)
        tags = ("Index", "Name", "Exclude")
        copied.children = [_bare(each) for each in pdo.children if each.tag in tags]
        for entry in pdo.iterfind("Entry"):
            names = ("Index", "SubIndex", "BitLen", "Name", "DataType")
            parts = [_bare(each) for each in entry.children if each.tag in names]
            copied.children.append(_node("Entry", "", *parts, line=entry.line))
        return copied

    def _mapped(self, index: int, owner: int) -> XmlElement:
        """Return a PDO that is in the commands of the file only."""
        entries = self._eni.mapping[index]
        is_output = self._managers[owner].is_output
        names = self._named(is_output, sum(each.bit_length for each in entries))
        parts = []
        for number, each in enumerate(entries):
            name, kind = f"{each.index:04X}_{each.subindex:02X}", ""
            if len(names) == len(entries) and names[number].bits == each.bit_length:
                name, kind = self._entry_name(names[number]), names[number].type
            parts.append(_entry(each.index, each.subindex, each.bit_length, name, kind))
        return _pdo(index, "", is_output, owner, parts)

    def _complete(self, number: int, manager: EniSyncManager) -> None:
        """Describe process data that no PDO of the file describes, and compare sizes."""
        own = [each for each in self._pdos.values() if each.get("Sm") == str(number)]
        missing = [index for index in manager.pdos or () if index not in self._pdos]
        described = sum(pdo_bits(each)[1] for each in own)
        others = [
            each
            for each in self._managers.values()
            if each.is_output is manager.is_output and not each.is_mailbox
        ]
        bits = manager.bits
        if bits is None and len(others) == 1:
            bits = self._eni.output_bits if manager.is_output else self._eni.input_bits
        if not missing and (own or not bits or manager.pdos == ()):
            if bits and described and (described + 7) // 8 != (bits + 7) // 8:
                self._warn(f"sync manager {number}: PDOs of {described} bits, its FMMU maps {bits}")
            return
        left = (bits or 0) - described
        if left <= 0:
            for index in missing:
                self._pdos[index] = _pdo(index, "", manager.is_output, number, [])
            if missing:
                text = ", ".join(f"0x{index:04X}" for index in missing)
                self._warn(f"the entries of PDO {text} are not in the file: give its ESI file")
            return
        named = self._named(manager.is_output, left)
        first = _FIRST_OBJECT[manager.is_output]
        parts = []
        for at, each in enumerate(named):
            place = first + at // _MAX_SUBINDEX, at % _MAX_SUBINDEX + 1
            parts.append(_entry(*place, each.bits, self._entry_name(each), each.type))
        if not parts:
            name = "outputs" if manager.is_output else "inputs"
            parts = [_entry(first, 1, left, name, "")]
        free = _FIRST_PDO[manager.is_output]
        index = (
            missing[0] if missing else next(n for n in range(free, 0x2000) if n not in self._pdos)
        )
        self._pdos[index] = _pdo(index, "", manager.is_output, number, parts)
        source = "named by the process image" if named else "one block"
        self._warn(
            f"the entries of {left} bits of {'outputs' if manager.is_output else 'inputs'} are not"
            f" in the file: {source}, with made-up objects; give its ESI file (--esi)"
        )

    def _named(self, is_output: bool, bits: int) -> list[EniVariable]:
        """Return the variables of one direction if they are all of its *bits*."""
        found = [each for each in self._variables if each.is_output is is_output and each.bits]
        # Those of the system are inputs too.
        found = [
            each for each in found if not self._inner(each).startswith(("WcState.", "InfoData."))
        ]
        found.sort(key=lambda each: each.offset)
        return found if sum(each.bits for each in found) == bits else []

    def _inner(self, variable: EniVariable) -> str:
        return variable.name.removeprefix(f"{self._eni.name}.")

    def _entry_name(self, variable: EniVariable) -> str:
        return self._inner(variable).replace(".", " ")

    def _fmmus(self) -> Iterator[XmlElement]:
        sides = {each.is_output for each in self._managers.values() if not each.is_mailbox}
        for is_output in sorted(sides, reverse=True):
            yield _node("Fmmu", "Outputs" if is_output else "Inputs")
        if any(each.is_mailbox for each in self._managers.values()):
            yield _node("Fmmu", "MBoxState")

    def _sync_managers(self) -> Iterator[XmlElement]:
        for number in range(max(self._managers, default=-1) + 1):
            each = self._managers.get(number)
            if each is None:
                keys = {"StartAddress": "#x1000", "ControlByte": "#x00", "Enable": "0"}
                yield _node("Sm", "Inputs", keys=keys)
                continue
            use = "Outputs" if each.is_output else "Inputs"
            if each.is_mailbox:
                use = "MBoxOut" if each.is_output else "MBoxIn"
            keys = {
                "StartAddress": f"#x{each.start:04X}",
                "ControlByte": f"#x{each.control:02X}",
                "Enable": str(int(each.is_enabled)),
            }
            if each.is_mailbox and each.size:
                keys["DefaultSize"] = str(each.size)
            yield _node("Sm", use, keys=keys)

    def _mailbox(self) -> XmlElement:
        eni = self._eni
        parts = []
        if "coe" in eni.protocols:
            keys = {"SdoInfo": "1", "CompleteAccess": "1"}
            if eni.assigns:
                keys["PdoAssign"] = "1"
            if eni.mapping:
                keys["PdoConfig"] = "1"
            parts.append(_node("CoE", "", keys=keys))
        others = ("FoE", "EoE", "VoE", "AoE")
        parts += [_node(name) for name in others if name.lower() in eni.protocols]
        if "soe" in eni.protocols:
            writes = [each for each in eni.writes if isinstance(each, IdnWrite)]
            channels = max((each.drive for each in writes), default=0) + 1
            commands = []
            for each in writes:
                at = [_node("Transition", str(one)) for one in each.at]
                rest = _node("IDN", str(each.idn)), _node("Data", each.data.hex())
                commands.append(_node("InitCmd", "", *at, *rest, keys={"Chn": str(each.drive)}))
            parts.append(_node("SoE", "", *commands, keys={"ChannelCount": str(channels)}))
        return _node("Mailbox", "", *parts, keys={"DataLinkLayer": "1"})

    def _dictionary(self) -> XmlElement | None:
        """Return the objects of the start-up writes, of the size that is written."""
        sizes: dict[int, dict[int, int]] = {}
        for each in self._eni.writes:
            if not isinstance(each, SdoWrite):
                continue
            entries = sizes.setdefault(each.index, {})
            if not each.complete:
                entries[each.subindex] = len(each.data)
            elif each.data[0]:
                size = max(1, (len(each.data) - 2) // each.data[0])
                entries |= dict.fromkeys(range(1, each.data[0] + 1), size)
        if not sizes:
            return None
        kinds, objects = [], []
        for index, entries in sizes.items():
            simple = entries.get(0, 1)
            kind, bits = _TYPES.get(simple, "BLOCK"), 8 * simple
            if set(entries) != {0}:
                kind, bits = f"DT{index:04X}", 16 + 8 * sum(entries.values())
                subs = [_sub_item(sub, size) for sub, size in sorted(entries.items()) if sub]
                parts = _node("Name", kind), _node("BitSize", str(bits)), *subs
                kinds.append(_node("DataType", "", *parts))
            name = f"0x{index:04X}"
            parts = _node("Index", f"#x{index:04X}"), _node("Name", name), _node("Type", kind)
            objects.append(_node("Object", "", *parts, _node("BitSize", str(bits))))
        return _node(
            "Dictionary", "", _node("DataTypes", "", *kinds), _node("Objects", "", *objects)
        )


def _sub_item(subindex: int, size: int) -> XmlElement:
    name = _node("Name", f"SubIndex {subindex:03}")
    kind, bits = _node("Type", _TYPES.get(size, "BLOCK")), _node("BitSize", str(8 * size))
    return _node("SubItem", "", _node("SubIdx", str(subindex)), name, kind, bits)


def _bare(element: XmlElement) -> XmlElement:
    return _node(element.tag, element.text, line=element.line)


def _entry(index: int, subindex: int, bits: int, name: str, kind: str) -> XmlElement:
    parts = [_node("Index", f"#x{index:04X}"), _node("SubIndex", str(subindex))]
    parts.append(_node("BitLen", str(bits)))
    if index:
        parts += [_node("Name", name), _node("DataType", kind)]
    return _node("Entry", "", *parts)


def _pdo(
    index: int, name: str, is_output: bool, manager: int, entries: Iterable[XmlElement]
) -> XmlElement:
    parts = _node("Index", f"#x{index:04X}"), _node("Name", name)
    return _node("RxPdo" if is_output else "TxPdo", "", *parts, *entries, keys={"Sm": str(manager)})


def xml_text(element: XmlElement, indent: str = "      ") -> str:
    """Return *element* as lines of XML."""
    keys = "".join(f" {name}={quoteattr(value)}" for name, value in element.attrib.items())
    if not element.children:
        text = escape(element.text)
        return (
            f"{indent}<{element.tag}{keys}>{text}</{element.tag}>\n"
            if text
            else (f"{indent}<{element.tag}{keys}/>\n")
        )
    if not any(each.children for each in element.children):
        line = "".join(xml_text(each, "").strip() for each in element.children)
        if len(line) <= _LINE:
            return f"{indent}<{element.tag}{keys}>{line}</{element.tag}>\n"
    inner = "".join(xml_text(each, f"{indent}  ") for each in element.children)
    return f"{indent}<{element.tag}{keys}>\n{inner}{indent}</{element.tag}>\n"
