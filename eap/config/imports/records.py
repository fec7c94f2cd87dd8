"""Records of imported files: EAP devices with their publishers and subscribers, and notes.

They hold what the file says, in its own terms: types by TwinCAT's names, destinations as written.
Settings that no reader knows are listed with their line.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum

import msgspec

from eap.codec.xmlstream import XmlElement, XmlError
from eap.config.finding import PlantFinding
from eap.ids import NetId

EAP_DEVICE = 112
"""DevType, or ItemSubType, of an EAP device."""
PUBLISHER, SUBSCRIBER = 9051, 9052
"""BoxTypes."""
DATA = "VarData"
"""Variable of a network variable that has its data; those beside it have its state."""
ARP_MS = 1000
"""Interval of the checks whether a receiver is present that TwinCAT offers."""
MAX_U16, MAX_U32 = 0xFFFF, 0xFFFF_FFFF
ITEMS = 10_000
"""Limit of the boxes of one import, and of the variables of one box."""


class UnknownSetting(msgspec.Struct, frozen=True):
    """A setting of a file whose meaning is not known."""

    line: int
    text: str
    """As the file has it: ``Eap TargetMac="…"``."""


class EapVariable(msgspec.Struct, frozen=True, kw_only=True):
    """One network variable, which is one PD.

    Attributes:
        name: As in the project.
        nv_id: ID of the PD.
        type: TwinCAT's name of its type.
        guid: GUID of that type, in upper case; empty if the file has none.
        bits: Size of its data; 0 if the file does not say.
        version: Data type version (TwinCAT 2: type hash).
        symbol: Variable of the PLC that is linked to it.
        cycle_us: Cycle of the task of that variable; 0 if it is not known.
        unknown: Settings that were not understood.
        line: Of the file.
    """

    name: str
    nv_id: int
    type: str = ""
    guid: str = ""
    bits: int = 0
    version: int = 0
    symbol: str = ""
    cycle_us: int = 0
    unknown: tuple[UnknownSetting, ...] = ()
    line: int = 0


class EapBox(msgspec.Struct, frozen=True, kw_only=True):
    """One publisher, which is one frame, or one subscriber.

    Attributes:
        name: As in the project.
        is_publisher: It sends.
        net_id: Publisher: NetID of the receiver of its unicast frames; subscriber: expected
            publisher; None if the file has none.
        mac: Destination MAC address of a publisher, multicast address of a subscriber; may be
            empty.
        udp: The same for UDP: an IPv4 address.
        gateway: Of UDP frames.
        divider: The frame leaves in each cycle that *divider* divides with the rest *modulo*.
        modulo: See divider.
        vlan_id: VLAN of the frames, 0 for none.
        vlan_priority: Priority in the VLAN tag.
        arp_ms: Interval of the checks whether the receiver of unicast frames is present.
        is_monitored: Those checks are made.
        is_changeable: The application may change the target.
        is_disabled: It is disabled in the project.
        variables: Its network variables.
        unknown: Settings that were not understood.
        file: Its file.
        line: In it.
    """

    name: str
    is_publisher: bool
    net_id: NetId | None = None
    mac: str = ""
    udp: str = ""
    gateway: str = ""
    divider: int = 1
    modulo: int = 0
    vlan_id: int = 0
    vlan_priority: int = 0
    arp_ms: int = ARP_MS
    is_monitored: bool = True
    is_changeable: bool = False
    is_disabled: bool = False
    variables: tuple[EapVariable, ...] = ()
    unknown: tuple[UnknownSetting, ...] = ()
    file: str = ""
    line: int = 0


class EapImportDevice(msgspec.Struct, frozen=True, kw_only=True):
    """One EAP device, which is one EAP port.

    Attributes:
        name: As in the project.
        net_id: Its own NetID; None if the file has none that can be used.
        mac: MAC address of its network adapter; may be empty.
        cycle_us: Its cycle; 0 if the file does not say.
        is_disabled: It is disabled in the project.
        boxes: Its publishers and subscribers.
        file: Its file.
        line: In it.
    """

    name: str
    net_id: NetId | None = None
    mac: str = ""
    cycle_us: int = 0
    is_disabled: bool = False
    boxes: tuple[EapBox, ...] = ()
    file: str = ""
    line: int = 0


class ImportOutcome(StrEnum):
    """Outcome of the import for one part of a file."""

    TAKEN = "taken"
    """It is in the plant file."""
    COMMENT = "comment"
    """It is in the plant file as a comment."""
    LEFT = "left"
    """It is not in the plant file."""
    WARNING = "warning"
    """It is in the plant file; the message says what to look at."""


class ImportNote(msgspec.Struct, frozen=True):
    """Outcome for one part of a file, with the reason."""

    file: str
    line: int
    item: str
    """Its path in the project, such as ``Device 1/Box 1/Var 1``."""
    outcome: ImportOutcome
    message: str


class ImportReport:
    """Collects the notes and findings of an import."""

    def __init__(self) -> None:
        self.notes: list[ImportNote] = []
        self.findings: list[PlantFinding] = []

    def note(self, file: str, line: int, item: str, outcome: ImportOutcome, message: str) -> None:
        """Record the outcome for *item*."""
        self.notes.append(ImportNote(file, line, item, outcome, message))

    def add(self, file: str, line: int, message: str, expected: str, *, item: str = "") -> None:
        """Report an error in *file*; nothing is written then."""
        self.findings.append(PlantFinding(file, line, item, message, expected))

    def add_error(self, file: str, error: XmlError, *, item: str = "") -> None:
        """Report an error of the XML."""
        self.add(file, error.line, str(error), error.expected, item=item)


def unknown_attributes(element: XmlElement, known: Iterable[str]) -> list[UnknownSetting]:
    """Return the attributes of *element* that are not *known*."""
    return [
        UnknownSetting(element.line, f'{element.tag} {name}="{_shown(value)}"')
        for name, value in element.attrib.items()
        if name not in set(known)
    ]


def unknown_children(element: XmlElement, known: Iterable[str]) -> list[UnknownSetting]:
    """Return the children of *element* that are not *known*."""
    return [
        UnknownSetting(child.line, f"{element.tag}/{child.tag} {_shown(child.text)}".rstrip())
        for child in element.children
        if child.tag not in set(known)
    ]


def six_bytes(text: str) -> bytes:
    """Return the bytes of 12 hexadecimal digits (MAC address, NetID); empty if it has others."""
    try:
        found = bytes.fromhex(text)
    except ValueError:
        return b""
    return found if len(found) == 6 else b""


def _shown(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= 60 else f"{line[:60]}…"
