"""EtherCAT network information (ENI, ETG.2100): the slaves of one bus, read from XML.

A master of other vendors runs the commands of such a file as they are.  This master sets up
addresses, sync managers, FMMUs and states by itself, so register commands are read for their facts
only: sync managers, sizes, SYNC0, time-outs.  Offsets of frames and process images differ between
the tools that write them and are not used: the process data is that of the PDO lists.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from eap.codec.soe import Element, Idn, SoeOpcode
from eap.codec.xmlstream import XmlElement, XmlError, XmlReader
from eap.config.imports.eni_records import (
    EniBus,
    EniSlave,
    EniSync,
    EniSyncManager,
    EniVariable,
)
from eap.config.imports.records import ImportOutcome, ImportReport
from eap.od.slave_config import (
    ALIAS_REGISTER,
    ID_REGISTER,
    IdnWrite,
    MappedObject,
    SdoWrite,
    Transition,
)

ROOT = "EtherCATConfig"
MAX_SLAVES = 1000
_MAX_COMMANDS = 10_000
_MAX_VARIABLES = 100_000
_MAX_NAME = 200
_U16, _U32 = 0xFFFF, 0xFFFF_FFFF
_CONFIG = f"{ROOT}/Config"
_WANTED = (
    f"{_CONFIG}/Master/Info",
    f"{_CONFIG}/Master/MailboxStates",
    f"{_CONFIG}/Slave",
    f"{_CONFIG}/Cyclic",
    f"{_CONFIG}/ProcessImage/Inputs",
    f"{_CONFIG}/ProcessImage/Outputs",
)
_DOWNLOAD, _UPLOAD = 1, 2
# Commands and registers are those of devicebus.wire, which eap.config may not import.
_READS = frozenset((1, 4))
"""Commands APRD and FPRD."""
_WRITES = frozenset((2, 5))
"""Commands APWR and FPWR."""
_FMMU, _MANAGER, _END = 0x600, 0x800, 0x880
_EEPROM = 0x502
# Words of the SII: 0x08 is the vendor, 0x0A the product.
_REVISION_WORD = 0x0C
_AL_STATUS, _ACTIVATE, _CYCLE0, _CYCLE1 = 0x130, 0x980, 0x9A0, 0x9A4
_ASSIGNMENTS, _MAPPINGS = range(0x1C10, 0x1C30), (range(0x1600, 0x1800), range(0x1A00, 0x1C00))
_MANAGERS = {f"Sm{number}": number for number in range(16)}
"""Sync managers by their elements in ProcessData."""
_USES = frozenset(("Outputs", "Inputs", "DynamicOutputs", "DynamicInputs"))
_MAILBOXES = ("Send",), ("Recv", "Receive")
"""Elements of the mailboxes to and from a slave; TwinCAT writes Recv, SOEM's sample Receive."""
_MAX_ENTRIES = 254
_FIRST_AREA = 0x0F00
"""Lowest address of process data: that of terminals with digital outputs."""
_MAX_TIMEOUT_MS = 600_000


def read_eni(chunks: Iterable[bytes], file: str, report: ImportReport) -> EniBus | None:
    """Return the bus of a file; None, with findings, if it cannot be used.

    Args:
        chunks: The content of the file.
        file: Its name, for findings.
        report: Takes the findings and the notes on what is left.
    """
    return _EniReader(file, report).read(chunks)


class _EniReader:
    """One file while it is read."""

    def __init__(self, file: str, report: ImportReport) -> None:
        self._file = file
        self._report = report
        self._slaves: list[EniSlave] = []
        self._variables: list[EniVariable] = []
        self._cycles: list[int] = []
        self._name = ""
        self._registers = 0
        self._commands = 0
        self._copies = 0
        self._first_cyclic = 0

    def read(self, chunks: Iterable[bytes]) -> EniBus | None:
        before = len(self._report.findings)
        try:
            for element in XmlReader(_WANTED, roots=(ROOT,)).read(chunks):
                try:
                    self._take(element)
                except XmlError as exc:
                    item = element.findtext("Info/Name")
                    self._report.add_error(self._file, exc, item=item)
        except XmlError as exc:
            self._report.add_error(self._file, exc)
        # A bus without some of its slaves would be a wrong one.
        if len(self._report.findings) > before:
            return None
        if not self._slaves:
            message = "it has no slave with a station address, process data or a mailbox"
            self._report.add(self._file, 0, message, "elements Config/Slave")
            return None
        self._note_commands()
        return EniBus(
            file=self._file,
            name=self._name,
            slaves=tuple(self._slaves),
            variables=tuple(self._variables),
            # One for each task: the bus has the cycle of the fastest.
            cycle_us=min(self._cycles, default=0),
        )

    def _take(self, element: XmlElement) -> None:
        if element.tag == "Info":
            self._name = element.findtext("Name")
        elif element.tag == "MailboxStates":
            message = "this master sees full mailboxes by its own means"
            self._report.note(self._file, element.line, element.tag, ImportOutcome.LEFT, message)
        elif element.tag == "Slave":
            self._take_slave(element)
        elif element.tag == "Cyclic":
            self._first_cyclic = self._first_cyclic or element.line
            if cycle := element.number_at("CycleTime", 0, _U32):
                self._cycles.append(cycle)
            self._commands += sum(1 for _ in element.iterfind("Frame/Cmd"))
            self._copies += sum(1 for _ in element.iterfind("Frame/Cmd/CopyInfos/CopyInfo"))
        else:
            self._take_image(element)

    def _take_image(self, image: XmlElement) -> None:
        for element in image.iterfind("Variable"):
            if len(self._variables) >= _MAX_VARIABLES:
                message = "the process image has too many variables"
                raise XmlError(message, line=element.line, expected=f"at most {_MAX_VARIABLES}")
            self._variables.append(
                EniVariable(
                    name=element.findtext("Name")[: 2 * _MAX_NAME],
                    type=element.findtext("DataType"),
                    bits=element.number_at("BitSize", 0, _U32),
                    offset=element.number_at("BitOffs", 0, _U32),
                    is_output=image.tag == "Outputs",
                )
            )

    def _note_commands(self) -> None:
        note = self._report.note
        if self._registers:
            message = (
                f"register commands ({self._registers}): this master sets up addresses, sync"
                " managers, FMMUs, clocks and states itself"
            )
            note(self._file, 0, "InitCmds", ImportOutcome.LEFT, message)
        if self._commands:
            message = (
                f"cyclic commands with their offsets ({self._commands}): this master lays out its"
                " frames and its process image itself, by the PDOs"
            )
            note(self._file, self._first_cyclic, "Cyclic", ImportOutcome.LEFT, message)
        if self._copies:
            message = f"copies from slave to slave ({self._copies}, CopyInfo): add links for them"
            note(self._file, self._first_cyclic, "Cyclic", ImportOutcome.WARNING, message)

    def _take_slave(self, element: XmlElement) -> None:
        name = element.findtext("Info/Name")[:_MAX_NAME] or f"slave {len(self._slaves) + 1}"
        content = ("ProcessData", "Mailbox", "InitCmds")
        if element.find("Info/PhysAddr") is None and not any(map(element.find, content)):
            message = "no station address and no commands: no EtherCAT slave, such as an end cap"
            self._report.note(self._file, element.line, name, ImportOutcome.LEFT, message)
            return
        if len(self._slaves) >= MAX_SLAVES:
            raise XmlError("too many slaves", line=element.line, expected=f"at most {MAX_SLAVES}")
        self._registers += sum(1 for _ in element.iterfind("InitCmds/InitCmd"))
        self._slaves.append(_SlaveReader(element, name, self._file, self._report).slave())


class _SlaveReader:
    """One slave while it is read."""

    def __init__(self, element: XmlElement, name: str, file: str, report: ImportReport) -> None:
        self._element = element
        self._name = name
        self._file = file
        self._report = report
        self._writes: list[SdoWrite | IdnWrite] = []
        self._refused: list[str] = []
        self._lists: dict[int, dict[int, bytes]] = {}
        """Subindexes of PDO assignment and mapping, in the order of their writes."""
        self._areas: dict[int, tuple[int, int, int]] = {}
        """Start, size and control byte of sync managers that commands set up."""
        self._mapped: dict[tuple[int, bool], int] = {}
        """Bits by physical address and direction."""
        self._times: dict[int, int] = {}
        """Values of the registers of SYNC0 and SYNC1."""
        self._timeouts: dict[str, int] = {}
        self._checked: set[int] = set()
        """Words of the EEPROM that commands read."""

    def slave(self) -> EniSlave:
        element = self._element
        info = element.find("Info")
        if info is None or info.find("VendorId") is None or info.find("ProductCode") is None:
            message = f"{self._name} has no identity"
            raise XmlError(message, line=element.line, expected="Info with VendorId, ProductCode")
        for command in _limited(element, "InitCmds/InitCmd"):
            self._take_register(command)
        for command in _limited(element, "Mailbox/CoE/InitCmds/InitCmd"):
            self._take_sdo(command)
        for command in _limited(element, "Mailbox/SoE/InitCmds/InitCmd"):
            self._take_idn(command)
        for protocol in ("AoE", "EoE", "FoE", "VoE"):
            if found := element.find(f"Mailbox/{protocol}/InitCmds/InitCmd"):
                hint = ": the key eoe of the port has IP settings" if protocol == "EoE" else ""
                self._note(found.line, ImportOutcome.LEFT, f"start-up commands of {protocol}{hint}")
        # The type is in EL2004-0000-0018, or in the name that TwinCAT gives: Term 2 (EL2004).
        revision = info.findtext("ProductRevision").partition("-")[0]
        inside = self._name.rpartition("(")[2].partition(")")[0] if "(" in self._name else ""
        hot = element.find("HotConnect")
        assigns, mapping = self._pdo_lists()
        managers = self._managers(assigns)
        pdos = self._pdos()
        mapping = self._known_mapping(mapping, managers, pdos)
        # As the master sees them: it sends outputs.
        sides = [f"ProcessData/{tag}/BitLength" for tag in ("Send", "Recv", "Receive")]
        bits = [element.number_at(path, 0, _U32) for path in sides]
        return EniSlave(
            name=self._name,
            line=element.line,
            address=info.number_at("PhysAddr", 0, _U16),
            vendor=_unsigned(info, "VendorId"),
            product=_unsigned(info, "ProductCode"),
            revision=_unsigned(info, "RevisionNo"),
            serial=_unsigned(info, "SerialNo"),
            type=revision or inside,
            managers=managers,
            pdos=tuple(pdos.values()),
            bootstrap=self._bootstrap(),
            protocols=frozenset(each.text.lower() for each in element.iterfind("Mailbox/Protocol"))
            | {each.tag.lower() for each in _children(element, "Mailbox")} & {"coe", "soe"},
            writes=tuple(self._writes),
            refused=tuple(self._refused),
            assigns=assigns,
            mapping=mapping,
            has_clock=element.find("DC") is not None or bool(self._times),
            sync=self._sync(),
            timeouts=self._timeouts,
            previous=self._previous(),
            group="" if hot is None else hot.findtext("GroupName") or self._name,
            members=1 if hot is None else hot.number_at("GroupMemberCnt", 1, MAX_SLAVES, 1),
            identification=None if hot is None else _identification(hot),
            # Commands compare words of the EEPROM: without that of the revision any one will do.
            any_revision=bool(self._checked) and _REVISION_WORD not in self._checked,
            output_bits=bits[0],
            input_bits=bits[1] or bits[2],
        )

    def _note(self, line: int, outcome: ImportOutcome, message: str) -> None:
        self._report.note(self._file, line, self._name, outcome, message)

    def _take_register(self, command: XmlElement) -> None:
        """Take the facts of a command that writes or checks registers."""
        code = command.number_at("Cmd", 0, _U16)
        register = command.number_at("Ado", 0, _U16)
        at = [each.text for each in command.iterfind("Transition")]
        if code in _READS and register == _AL_STATUS:
            self._take_timeout(command, at)
        # Commands of the way down clear what those of the way up have set.
        if code not in _WRITES or not {"IP", "PS", "SO"} & set(at):
            return
        data = _octets(command)
        # Two bytes of control, then the address of the word to read.
        if register == _EEPROM and len(data) >= 4:
            self._checked.add(data[2])
        if _FMMU <= register < _MANAGER:
            for start in range(0, len(data) - 15, 16):
                self._take_fmmu(data[start : start + 16])
        elif _MANAGER <= register < _END:
            for start in range(0, len(data) - 7, 8):
                self._take_manager((register - _MANAGER + start) // 8, data[start : start + 8])
        elif _ACTIVATE <= register < _ACTIVATE + 2 or _CYCLE0 <= register < _CYCLE1 + 4:
            self._take_time(register, data)

    def _take_manager(self, number: int, data: bytes) -> None:
        place = int.from_bytes(data[:2], "little")
        if place:
            self._areas[number] = place, int.from_bytes(data[2:4], "little"), data[4]

    def _take_time(self, register: int, data: bytes) -> None:
        value = int.from_bytes(data[:4], "little")
        # The two bytes of AssignActivate are registers of their own.
        if register == _ACTIVATE + 1:
            register, value = _ACTIVATE, (value & 0xFF) << 8
        if register == _ACTIVATE:
            # It is cleared before it is set.
            value = value & _U16 or self._times.get(_ACTIVATE, 0)
        self._times[register] = value
        if register == _CYCLE0 and len(data) > 4:
            self._times[_CYCLE1] = int.from_bytes(data[4:8], "little")

    def _take_fmmu(self, data: bytes) -> None:
        length = int.from_bytes(data[4:6], "little")
        # From the start bit of the first byte to the stop bit of the last one.
        bits = 8 * (length - 1) - data[6] + data[7] + 1
        if length and bits > 0 and data[11] in {1, 2}:
            place = int.from_bytes(data[8:10], "little"), data[11] == 2
            self._mapped[place] = bits

    def _take_timeout(self, command: XmlElement, at: list[str]) -> None:
        timeout = command.number_at("Validate/Timeout", 0, _U32)
        # A command for several transitions has the same time-out for each.  SAFEOP and OP have one
        # in ESI files (SafeopOpTimeout): the longer of both.
        for transition, key in (("IP", "preop_ms"), ("SO", "safeop_op_ms"), ("PS", "safeop_op_ms")):
            if transition in at and 0 < timeout <= _MAX_TIMEOUT_MS:
                # Only the command that waits for a state has the time-out of a transition.
                state = (_octets(command, "Validate/Data") or b"\0")[0]
                if state in {2, 4, 8}:
                    self._timeouts[key] = max(timeout, self._timeouts.get(key, 0))

    def _take_sdo(self, command: XmlElement) -> None:
        index = _unsigned(command, "Index", 16)
        subindex = _unsigned(command, "SubIndex", 8)
        what = f"0x{index:04X}:{subindex:02X}"
        service = command.number_at("Ccs", 0, _U16, _DOWNLOAD)
        data = _octets(command)
        at = self._transitions(command, what)
        if not at:
            return
        if service == _UPLOAD and data:
            text = f"{what}: {data.hex(' ')} on {', '.join(at)}"
            message = (
                f"Ccs 2 has data ({text}): TwinCAT means an upload by 2, SOEM's converter a write."
                " Nothing is written: set Ccs to 1 if a write is meant"
            )
            self._note(command.line, ImportOutcome.COMMENT, message)
            self._refused.append(f"Not written, Ccs 2 is an upload: {text}")
            return
        if service != _DOWNLOAD:
            kind = "an upload" if service == _UPLOAD else f"Ccs {service}"
            self._note(command.line, ImportOutcome.LEFT, f"{what}: {kind}, nothing is written")
            return
        if not data:
            raise XmlError(f"{what} has no data", line=command.line, expected="element Data")
        complete = command.attribute_flag("CompleteAccess")
        # Assignment and mapping are keys of their own: the master writes them in the right order.
        if index in _ASSIGNMENTS or any(index in each for each in _MAPPINGS):
            self._take_list(index, subindex, data, complete)
            return
        if complete and subindex > 1:
            message = f"{what} with complete access"
            raise XmlError(message, line=command.line, expected="SubIndex 0 or 1")
        self._writes.append(
            SdoWrite(
                at=at,
                index=index,
                subindex=subindex,
                data=data,
                complete=complete,
                comment=_line(command.findtext("Comment")),
            )
        )

    def _take_list(self, index: int, subindex: int, data: bytes, complete: bool) -> None:
        size = 2 if index in _ASSIGNMENTS else 4
        if not complete:
            self._lists.setdefault(index, {})[subindex] = data
            return
        # Subindex 0 takes two bytes.
        self._lists[index] = {
            0: data[:1],
            **{
                number: data[start : start + size]
                for number, start in enumerate(range(2, len(data), size), 1)
            },
        }

    def _take_idn(self, command: XmlElement) -> None:
        number = _unsigned(command, "IDN", 16)
        what = str(Idn.of(number))
        operation = command.number_at("OpCode", 0, _U16, SoeOpcode.WRITE_REQUEST)
        elements = command.number_at("Elements", 0, _U16, Element.VALUE)
        at = self._transitions(command, what)
        data = _octets(command)
        if not at:
            return
        if operation != SoeOpcode.WRITE_REQUEST or not elements & Element.VALUE or not data:
            self._note(command.line, ImportOutcome.LEFT, f"{what}: no write of a value")
            return
        self._writes.append(
            IdnWrite(
                at=at,
                idn=number,
                data=data,
                drive=command.number_at("DriveNo", 0, 7),
                comment=_line(command.findtext("Comment")),
            )
        )

    def _transitions(self, command: XmlElement, what: str) -> tuple[Transition, ...]:
        """Return the transitions of a start-up command that count; empty after a note."""
        if command.flag_at("Disabled"):
            self._note(command.line, ImportOutcome.LEFT, f"{what}: disabled in the file")
            return ()
        texts = [each.text for each in command.iterfind("Transition")]
        known = tuple(Transition(text) for text in texts if text in set(Transition))
        if len(known) < len(texts) or not texts:
            others = ", ".join(text[:10] for text in texts if text not in set(Transition))
            message = f"{what}: transition {others or 'none'} has no start-up writes here"
            self._note(command.line, ImportOutcome.LEFT, message)
        return known

    def _pdos(self) -> dict[int, XmlElement]:
        """Return the PDOs, whose numbers are checked, by index."""
        found: dict[int, XmlElement] = {}
        for pdo in _children(self._element, "ProcessData"):
            if pdo.tag not in {"RxPdo", "TxPdo"}:
                continue
            index = pdo.number_at("Index", 1, _U16)
            if not index or index in found:
                message = f"{pdo.tag} 0x{index:04X} is there twice, or has no index"
                raise XmlError(message, line=pdo.line, expected="an index of its own")
            found[index] = pdo
            for entry in pdo.iterfind("Entry"):
                entry.number_at("Index", 0, _U16)
                entry.number_at("SubIndex", 0, 0xFF)
                entry.number_at("BitLen", 0, _U16)
        return found

    def _pdo_lists(
        self,
    ) -> tuple[dict[int, tuple[int, ...]], dict[int, tuple[MappedObject, ...]]]:
        """Return PDO assignment and mapping as the start-up commands write them."""
        assigns: dict[int, tuple[int, ...]] = {}
        mapping: dict[int, tuple[MappedObject, ...]] = {}
        for index, values in self._lists.items():
            count = int.from_bytes(values.get(0, b"\0"), "little")
            entries = [
                int.from_bytes(values.get(number, b""), "little")
                for number in range(1, min(count, _MAX_ENTRIES) + 1)
            ]
            if 0 in entries:
                message = f"0x{index:04X} has {count} entries, not all of which are written"
                raise XmlError(message, line=self._element.line, expected="a write for each")
            if index in _ASSIGNMENTS:
                assigns[index - _ASSIGNMENTS.start] = tuple(each & _U16 for each in entries)
            else:
                mapping[index] = tuple(
                    MappedObject(each >> 16 & _U16, each >> 8 & 0xFF, each & 0xFF)
                    for each in entries
                )
        return assigns, mapping

    def _known_mapping(
        self,
        mapping: Mapping[int, tuple[MappedObject, ...]],
        managers: Mapping[int, EniSyncManager],
        pdos: Mapping[int, XmlElement],
    ) -> dict[int, tuple[MappedObject, ...]]:
        """Return the mapping of PDOs that the file has; notes on the others."""
        known = {index for each in managers.values() for index in each.pdos or ()} | pdos.keys()
        for index in sorted(mapping.keys() - known):
            message = f"mapping of PDO 0x{index:04X}, which no sync manager has"
            self._note(self._element.line, ImportOutcome.LEFT, message)
        return {index: entries for index, entries in mapping.items() if index in known}

    def _managers(self, assigns: Mapping[int, tuple[int, ...]]) -> dict[int, EniSyncManager]:
        found: dict[int, EniSyncManager] = {}
        for number, box in enumerate(_mailboxes(self._element, "Mailbox")):
            if box is not None:
                found[number] = EniSyncManager(
                    start=box.number_at("Start", 0, _U16),
                    size=box.number_at("Length", 0, _U16),
                    # As in ESI files: one mailbox is written by the master, one read.
                    control=(0x26, 0x22)[number],
                    is_output=not number,
                    is_mailbox=True,
                )
        for number, (start, size, control) in self._areas.items():
            # Bits 0 and 1: 2 is a mailbox; bits 2 and 3: 1 is written by the master.
            if number in _MANAGERS.values() and number not in found and control & 3 != 2:
                is_output = control >> 2 & 3 == 1
                found[number] = EniSyncManager(
                    start=start,
                    size=size,
                    control=control,
                    is_output=is_output,
                    bits=self._mapped.get((start, is_output)),
                    pdos=assigns.get(number),
                )
        for element in _children(self._element, "ProcessData"):
            if element.tag in _MANAGERS:
                number = _MANAGERS[element.tag]
                found[number] = self._manager(element, number, assigns, found.get(number))
        # The mailboxes of a slave are sync managers 0 and 1.
        first = 2 if any(each.is_mailbox for each in found.values()) else 0
        for (start, is_output), bits in sorted(self._mapped.items()):
            # An FMMU whose sync manager is nowhere in the file.
            if start >= _FIRST_AREA and all(each.start != start for each in found.values()):
                number = next(each for each in range(first, 64) if each not in found)
                # Three buffers, as terminals have it; outputs with their watchdog.
                control = 0x64 if is_output else 0x20
                found[number] = EniSyncManager(
                    start=start, control=control, is_output=is_output, bits=bits
                )
        return dict(sorted(found.items()))

    def _manager(
        self,
        element: XmlElement,
        number: int,
        assigns: Mapping[int, tuple[int, ...]],
        before: EniSyncManager | None,
    ) -> EniSyncManager:
        kind = element.findtext("Type")
        if kind not in _USES:
            message = f"{element.tag} has Type {kind[:40]!r}"
            raise XmlError(message, line=element.line, expected="Outputs or Inputs")
        start = element.number_at("StartAddress", 0, _U16)
        is_output = kind.endswith("Outputs")
        listed = tuple(each.number(0, _U16) for each in element.iterfind("Pdo"))
        return EniSyncManager(
            start=start,
            size=element.number_at("DefaultSize", 0, _U16, before.size if before else 0),
            control=element.number_at("ControlByte", 0, 0xFF),
            is_enabled=element.flag_at("Enable", default=True),
            is_output=is_output,
            pdos=listed or assigns.get(number) or (),
            bits=self._mapped.get((start, is_output)),
        )

    def _bootstrap(self) -> bytes:
        return b"".join(
            box.number_at(path, 0, _U16).to_bytes(2, "little")
            for box in _mailboxes(self._element, "Mailbox/BootStrap")
            if box is not None
            for path in ("Start", "Length")
        )

    def _sync(self) -> EniSync | None:
        clock = self._element.find("DC")
        cycle0 = self._times.get(_CYCLE0, 0)
        cycle1 = self._times.get(_CYCLE1, 0)
        shift = 0
        if clock is not None:
            low, high = -(1 << 31), _U32
            # Registers go first: they are what a slave would get.  Times of DC have a sign.
            cycle0 = cycle0 or max(0, clock.number_at("CycleTime0", low, high))
            if _CYCLE0 not in self._times:
                cycle1 = max(0, clock.number_at("CycleTime1", low, high))
            shift = clock.number_at("ShiftTime", low, high)
        activate = self._times.get(_ACTIVATE)
        if not cycle0 and not activate:
            return None
        if activate is None:
            line = self._element.line if clock is None else clock.line
            if self._element.find("ProcessData") is None:
                message = "times of SYNC0 that nothing activates, for a slave without process data"
                self._note(line, ImportOutcome.LEFT, message)
                return None
            message = "no command activates SYNC0: it is switched on for the times of DC"
            self._note(line, ImportOutcome.WARNING, message)
        return EniSync(activate=activate, cycle0_ns=cycle0, cycle1_ns=cycle1, shift_ns=shift)

    def _previous(self) -> tuple[str, int] | None:
        found = list(self._element.iterfind("PreviousPort"))
        chosen = next((each for each in found if each.attribute_flag("Selected")), None)
        chosen = chosen or next((each for each in found if each.find("PhysAddr")), None)
        if chosen is None or chosen.find("PhysAddr") is None:
            return None
        return chosen.findtext("Port"), chosen.number_at("PhysAddr", 0, _U16)


def _identification(hot: XmlElement) -> tuple[int, int] | None:
    """Return the register, and its value, by which a hot-connect group is found."""
    for command in hot.iterfind("IdentifyCmd"):
        register = command.number_at("Ado", 0, _U16)
        if register in {ALIAS_REGISTER, ID_REGISTER}:
            value = int.from_bytes(_octets(command, "Validate/Data"), "little")
            if 0 < value <= _U16:
                return register, value
    return None


def _limited(element: XmlElement, path: str) -> Iterator[XmlElement]:
    for number, each in enumerate(element.iterfind(path)):
        if number >= _MAX_COMMANDS:
            raise XmlError("too many commands", line=each.line, expected=f"at most {_MAX_COMMANDS}")
        yield each


def _children(element: XmlElement, path: str) -> list[XmlElement]:
    found = element.find(path)
    return [] if found is None else found.children


def _mailboxes(element: XmlElement, path: str) -> list[XmlElement | None]:
    """Return the elements of the mailboxes to and from a slave at *path*."""
    return [
        next((box for tag in tags if (box := element.find(f"{path}/{tag}"))), None)
        for tags in _MAILBOXES
    ]


def _unsigned(element: XmlElement, path: str, bits: int = 32) -> int:
    """Return a number of *bits* bits; one with its top bit set may be negative."""
    # Tools write numbers whose top bit is set as negative ones.
    limit = 1 << bits
    return element.number_at(path, -(limit >> 1), limit - 1) % limit


def _octets(command: XmlElement, path: str = "Data") -> bytes:
    found = command.find(path)
    try:
        return bytes.fromhex("" if found is None else found.text)
    except ValueError:
        assert found is not None  # noqa: S101  an empty text is valid
        raise XmlError(
            f"{path} is {found.text[:40]!r}",
            line=found.line,
            expected="pairs of hexadecimal digits",
        ) from None


def _line(text: str) -> str:
    return " ".join(text.split())[:120]
