"""The EAP device: modular device profile 5001, sub-profile 1000 (ETG.5001, ETG.1005).

The ranges, the meaning of the objects and the sub-indexes 3, 4 and 6 of process data come from
descriptions of the profile; the rest of the sub-index tables is ours, as no public document has
them.  Clients find everything by name through SDO information.
"""

from __future__ import annotations

from eap.od.model import RO, RW, Access, ObjectCode
from eap.od.profiles.eap1000keys import Derived, Live
from eap.od.profiles.forms import Form
from eap.od.profiles.table import (
    CONFIG,
    OWN_TYPE,
    EntryRow,
    ObjectRange,
    config,
    derived,
    fixed,
    live,
)

PROFILE = 5001
"""Of modular devices; the vendor's description of its own EAP device says 5002."""
MODULE_PROFILE = 1000

NAME = "STRING(255)"
TEXT = "STRING(1000)"
MAX_ENTRIES = 254
"""Highest sub-index of a list: 255 is reserved for the object's structure."""
WHOLE = 0xFF
"""Bit length in a mapping entry of a variable too long for the eight bits there."""

_RECORD, _ARRAY, _VAR = ObjectCode.RECORD, ObjectCode.ARRAY, ObjectCode.VAR

_VARIABLE = (
    derived(2, "Bit length", "UDINT", Derived.BIT_LENGTH, "Bits that travel."),
    derived(3, "Data type", "UINT", Derived.TYPE_CODE, "Index of the base type."),
    config(4, "Type name", "STRING(40)", "Such as UINT, REAL[4] or BLOCK(600).", default="UINT"),
    config(5, "Name", NAME, "Unique in the station."),
    config(6, "Unit", NAME, "Text for people."),
    config(7, "Comment", TEXT, "Text for people."),
    config(8, "Default given", "BOOL", "Whether the next entry counts; else it starts as zero."),
    config(9, "Default", OWN_TYPE, "Value at the start, and as a substitute."),
)
_VALUE = EntryRow(
    1, "Value", OWN_TYPE, RO, "As it lies in the process image.", live=Live.VALUE.value
)
TX_VARIABLE = ObjectRange(
    0x6000, 0x6FFF, "Tx variable {n}", _RECORD,
    (
        _VALUE._replace(access=RO | Access.TX_MAPPABLE),
        *_VARIABLE,
        config(10, "Writer", "USINT", "0 user programs, 1 the cycle, 2 measurements and files.",
               maximum=2),
    ),
    "A variable that can be sent; its value travels, in the order of the PDO. One that another "
    "port or a bus of the station has by the same name is that one, and described alike.",
    dynamic=True,
)  # fmt: skip
RX_VARIABLE = ObjectRange(
    0x7000, 0x7FFF, "Rx variable {n}", _RECORD,
    (_VALUE._replace(access=RO | Access.TX_MAPPABLE | Access.RX_MAPPABLE), *_VARIABLE),
    "A variable that is received; it may be sent on.", dynamic=True,
)  # fmt: skip

_MAPPED = (
    config(1, "Mapping {n}", "UDINT", "Index, sub-index and bit length (16, 8, 8 bits); index 0 "
           "is padding, bit length 255 the whole of a longer variable.", last=MAX_ENTRIES,
           form=Form.MAPPING),
)  # fmt: skip
RX_PDO = ObjectRange(
    0x1600, 0x17FF, "RxPDO mapping {n}", _ARRAY, _MAPPED,
    "Variables of a received PD in their order.", dynamic=True, mapping=True,
)  # fmt: skip
TX_PDO = ObjectRange(
    0x1A00, 0x1BFF, "TxPDO mapping {n}", _ARRAY, _MAPPED,
    "Variables of a sent PD in their order.", dynamic=True, mapping=True,
)  # fmt: skip
MORE_RX_PDO = RX_PDO._replace(
    first=0x2000, last=0x2DFF, name="Further RxPDO mapping {n}",
    description="As 0x1600, for ports that receive more than 512 different PDOs.",
)  # fmt: skip
MORE_TX_PDO = TX_PDO._replace(
    first=0x3000, last=0x3DFF, name="Further TxPDO mapping {n}",
    description="As 0x1A00, for ports that send more than 512 different PDOs.",
)  # fmt: skip

TX_FRAME = ObjectRange(
    0x8000, 0x8FFF, "TxFrame {n}", _RECORD,
    (
        config(1, "Enabled", "BOOL", "A frame that is not is left alone altogether."),
        config(2, "Address mode", "USINT", "0 MAC, 1 NetID, 2 IP by UDP, 3 IP by TCP, 4 whoever "
               "asked for its PDs.", maximum=4, changeable=True),
        config(3, "Destination MAC", "BLOCK(6)", "Address mode 0; in mode 1 that of the NetID, and "
               "all zero or a group if it is to be learned.",
               default=bytes.fromhex("010105040000"), form=Form.MAC, changeable=True),
        config(4, "Destination NetID", "BLOCK(6)", "Address mode 1.", form=Form.NET_ID,
               changeable=True),
        config(5, "Destination IP", "BLOCK(4)", "Address modes 2 and 3, first octet first.",
               form=Form.IP, changeable=True),
        config(6, "Port number", "UINT", "UDP or TCP; 0 is 34980.", changeable=True),
        config(7, "Monitoring interval", "UDINT", "How often to look whether the subscriber is "
               "there; 0 never.", unit="ms"),
        live(8, "Frame state", "UINT", Live.FRAME_STATE,
             "Bit 0 not sent, bit 1 too long, bit 2 subscriber missing."),
        config(9, "Name", NAME, "Unique among the station's frames."),
        config(10, "Divider", "UINT", "Leaves only in cycles whose number, divided by this, leaves "
               "the modulo; 0 off."),
        config(11, "Modulo", "UINT", "Less than the divider."),
        config(12, "Monitor IP", "BLOCK(4)", "Whom to probe for on Ethernet; all "
               "zero nobody.", form=Form.IP),
        config(13, "Changeable", "BOOL", "Whether the destination may be written in SafeOp and "
               "Op."),
        live(14, "Frame control", "UINT", Live.FRAME_CTRL, "Bit 0 suppresses the frame."),
        derived(15, "Frame length", "UINT", Derived.FRAME_LENGTH, "Octets with all its PDs."),
        config(16, "TxPD {n}", "UINT", "Index of a PD that it carries; 0 none.",
               last=MAX_ENTRIES, form=Form.INDEX),
    ),
    "One frame to send: where it goes and what is in it.", dynamic=True, companion=0xA000,
)  # fmt: skip
FRAME_DIAGNOSIS = ObjectRange(
    0xA000, 0xAFFF, "TxFrame diagnosis {n}", _RECORD,
    (
        live(1, "Sent whole", "ULINT", Live.FRAME_WHOLE, "With all PDs by the same schedule."),
        live(2, "Sent otherwise", "ULINT", Live.FRAME_PARTIAL, "With some of its PDs."),
        live(3, "Skipped", "ULINT", Live.FRAME_SKIPPED, "Suppressed, or refused by the network."),
    ),
    "What became of the TxFrame of the same number.",
)  # fmt: skip
TX_PD = ObjectRange(
    0xD000, 0xDFFF, "TxPD {n}", _RECORD,
    (
        config(1, "PDO index", "UINT", "Mapping that it carries (0x1A00 or 0x3000 on); 0 none.",
               form=Form.INDEX),
        derived(2, "PDO length", "UINT", Derived.PDO_LENGTH, "Octets of data."),
        config(3, "PD ID", "UINT", "Unique per publisher.", changeable=True),
        config(4, "Version", "UINT", "Of the layout; subscribers discard others."),
        config(5, "Enabled", "BOOL", "A PD that is not is left out of its frame."),
        fixed(6, "Publisher", "BLOCK(6)", "NetID of this port.", form=Form.NET_ID),
        config(7, "Cycle time", "UDINT", "Whole multiple of the device cycle; 0 off.", unit="us"),
        config(8, "Divider", "UINT", "Sent in cycles whose number, divided by this, leaves the "
               "modulo; 0 off."),
        config(9, "Modulo", "UINT", "Less than the divider."),
        config(10, "Poll request RxPD", "UINT", "Sent as the answer to this RxPD; 0 none.",
               form=Form.INDEX, changeable=True),
        config(11, "On change timeout", "UDINT", "Sent again though unchanged; 0 never. Other "
               "than 0 it switches sending on change on.", unit="ms"),
        config(12, "On change inhibit", "UDINT", "Shortest gap between two changes; 0 none. Other "
               "than 0 it switches sending on change on.", unit="us"),
        live(13, "VarState", "UINT", Live.TX_VAR_STATE, "Bit 0 not sent."),
        config(14, "Name", NAME, "Unique among the station's sent PDs."),
        config(15, "On change", "BOOL", "Sent when the data differs from what was sent last."),
        config(16, "Event", "BOOL", "Sent when bit 1 of its VarCtrl rises."),
        config(17, "Changeable", "BOOL", "Whether PD ID and poll request may be written in "
               "SafeOp and Op."),
        live(18, "VarCtrl", "UINT", Live.TX_VAR_CTRL, "Bit 0 suppresses the PD, bit 1 sends it."),
    ),
    "One PD to send: which PDO, and when.", dynamic=True, companion=0xB000,
)  # fmt: skip
TX_DIAGNOSIS = ObjectRange(
    0xB000, 0xBFFF, "TxPD diagnosis {n}", _RECORD,
    (
        live(1, "Last reason", "USINT", Live.TX_LAST_REASON, "Of the entries 3 to 8: 0 the first."),
        live(2, "Skipped", "ULINT", Live.TX_SKIPPED, "Due, but suppressed."),
        live(3, "Sent by cycle", "ULINT", Live.TX_SENT_CYCLE, "In its own rhythm."),
        live(4, "Sent by divider", "ULINT", Live.TX_SENT_DIVIDER, "Its own, or its frame's."),
        live(5, "Sent on change", "ULINT", Live.TX_SENT_CHANGE, "Since the start."),
        live(6, "Sent unchanged", "ULINT", Live.TX_SENT_CHANGE_TIMEOUT, "After the timeout."),
        live(7, "Sent on event", "ULINT", Live.TX_SENT_EVENT, "Since the start."),
        live(8, "Sent on request", "ULINT", Live.TX_SENT_POLL, "As an answer."),
    ),
    "Why the TxPD of the same number was sent.",
)  # fmt: skip
RX_PD = ObjectRange(
    0xE000, 0xEFFF, "RxPD {n}", _RECORD,
    (
        config(1, "PDO index", "UINT", "Mapping that takes it (0x1600 or 0x2000 on); 0 none.",
               form=Form.INDEX),
        derived(2, "PDO length", "UINT", Derived.PDO_LENGTH, "Octets of data."),
        config(3, "PD ID", "UINT", "Expected ID.", changeable=True),
        config(4, "Version", "UINT", "Expected version of the layout."),
        config(5, "Flags", "USINT", "Bit 7 enabled; bit 0: the NetID is ignored, bit 2: the "
               "version is. ID and length never are: bits 1 and 3 are 0.", form=Form.HEX),
        config(6, "Publisher", "BLOCK(6)", "NetID of the sender; all zero is any.",
               form=Form.NET_ID, changeable=True),
        config(7, "Poll request TxPD", "UINT", "The TxPD that this one answers; 0 none.",
               form=Form.INDEX, changeable=True),
        live(8, "Quality", "UINT", Live.RX_QUALITY, "Age of the data.", unit="100 us"),
        live(9, "Cycle index", "UINT", Live.RX_CYCLE_INDEX, "Cycle counter of the sender."),
        live(10, "VarState", "UINT", Live.RX_VAR_STATE, "Last one refused for: bit 0 version, "
             "bit 1 length."),
        config(11, "Name", NAME, "Unique among the station's received PDs."),
        config(12, "Time-out", "UDINT", "Age at which the substitute applies; 0 never.", unit="ms"),
        config(13, "Substitute", "USINT", "0 hold the last values, 1 zero, 2 the defaults.",
               maximum=2),
        config(14, "Sender cycle", "UDINT", "Device cycle of the sender; 0 unknown.", unit="us"),
        config(15, "Step", "UDINT", "Sender cycles between two of this PD; 0 no fixed step."),
        config(16, "Changeable", "BOOL", "Whether PD ID, NetID and poll request may be written in "
               "SafeOp and Op."),
        live(17, "State", "USINT", Live.RX_STATE, "0 waiting, 1 running, 2 stale."),
        config(18, "Source", "STRING(40)", "Address that its frames must come from: MAC on "
               "Ethernet, else IPv4; empty any. Writing another publisher empties it.",
               changeable=True),
    ),
    "One PD to receive: from whom, and into which PDO.", dynamic=True, companion=0xC000,
)  # fmt: skip
RX_DIAGNOSIS = ObjectRange(
    0xC000, 0xCFFF, "RxPD diagnosis {n}", _RECORD,
    (
        live(1, "Received", "ULINT", Live.RX_RECEIVED, "PDs taken."),
        live(2, "Lost", "ULINT", Live.RX_LOST, "Told from the cycle counter."),
        live(3, "Duplicated", "ULINT", Live.RX_DUPLICATED, "Came twice."),
        live(4, "Reordered", "ULINT", Live.RX_REORDERED, "Came behind a later one."),
        live(5, "Late", "ULINT", Live.RX_LATE, "Came, but not in time."),
        live(6, "Time-outs", "ULINT", Live.RX_TIMEOUTS, "How often the substitute applied."),
        live(7, "Largest jitter", "UDINT", Live.RX_JITTER_MAX, "Since the start.", unit="us"),
        live(8, "Wrong version", "ULINT", Live.RX_DISCARDED_VERSION, "Discarded for it."),
        live(9, "Wrong length", "ULINT", Live.RX_DISCARDED_LENGTH, "Discarded for it."),
        live(10, "Not in Op", "ULINT", Live.RX_DISCARDED_SUPPRESSED, "Discarded for it."),
        live(11, "Stale", "ULINT", Live.RX_DISCARDED_STALE, "Had waited since before the start."),
        live(12, "Wrong source", "ULINT", Live.RX_DISCARDED_WRONG_SOURCE,
             "Discarded for it: came from another address."),
    ),
    "What became of the RxPD of the same number.",
)  # fmt: skip

_KINDS = ("TxFrames", "TxPDs", "RxPDs", "TxPDOs", "RxPDOs", "Tx variables", "Rx variables")
COUNTED = ((TX_FRAME,), (TX_PD,), (RX_PD,), (TX_PDO, MORE_TX_PDO), (RX_PDO, MORE_RX_PDO),
           (TX_VARIABLE,), (RX_VARIABLE,))  # fmt: skip
"""The ranges behind sub-indexes 1 to 7 of 0xF800 and 0xF801."""


def _single(index: int, name: str, description: str, *entries: EntryRow) -> ObjectRange:
    code = _VAR if entries[0].subindex == 0 else _ARRAY if entries[0].last else _RECORD
    described = tuple(
        each._replace(description=each.description or description) for each in entries
    )
    return ObjectRange(index, index, name, code, described, description)


IDENTITY = (
    _single(0x1000, "Device type", "Profile in the low word, module profile in the high one.",
            fixed(0, "Device type", "UDINT", "", default=MODULE_PROFILE << 16 | PROFILE,
                  form=Form.HEX)),
    _single(0x1008, "Device name", "Of the product.", fixed(0, "Device name", NAME, "")),
    _single(0x1009, "Hardware version", "Of the host.", fixed(0, "Hardware version", NAME, "")),
    _single(0x100A, "Software version", "Of the product.", fixed(0, "Software version", NAME, "")),
    _single(0x1018, "Identity", "Who made what.",
            fixed(1, "Vendor ID", "UDINT", "0: not a member of the ETG."),
            fixed(2, "Product code", "UDINT", "Of the product."),
            fixed(3, "Revision", "UDINT", "Of the product."),
            fixed(4, "Serial number", "UDINT", "Of the device; 0 none.")),
)  # fmt: skip
DEVICE = (
    _single(0xF000, "Modular device profile", "How the objects are numbered.",
            fixed(1, "Index distance", "UINT", "Between two objects of a range.", default=1),
            fixed(2, "Maximum number", "UINT", "Of objects of a kind.", default=0x1000)),
    _single(0xF100, "EAP status", "Where the device stands.",
            fixed(1, "State", "UINT", "1 Init, 2 PreOp, 4 SafeOp, 8 Op; bit 4: an error."),
            fixed(2, "Error code", "UINT", "Why the last request was refused; 0 it was not."),
            fixed(3, "Error text", TEXT, "The same in words."),
            fixed(4, "Error object", "UDINT", "Index and sub-index (16, 8 bits, then zero) that "
                  "the error is about; 0 none.", form=Form.HEX)),
    _single(0xF110, "Device diagnosis", "Counters of the whole station.",
            live(1, "Cycle", "ULINT", Live.STATION_CYCLE, "Device cycles run."),
            live(2, "Overruns", "ULINT", Live.STATION_OVERRUNS, "Cycles left out, being too late."),
            live(3, "Restarts", "ULINT", Live.STATION_RESTARTS, "Of the engine."),
            live(4, "Torn", "ULINT", Live.STATION_TORN, "Cycles with half-written variables."),
            live(5, "Largest lateness", "ULINT", Live.STATION_LATENESS_MAX, "In nanoseconds."),
            live(6, "Links held", "ULINT", Live.STATION_LINKS_HELD, "Values no link could pass."),
            live(7, "Wrong publisher", "ULINT", Live.STATION_DISCARDED_WRONG_PUBLISHER,
                 "PDs discarded for it."),
            live(8, "Unknown ID", "ULINT", Live.STATION_DISCARDED_UNKNOWN_ID,
                 "PDs discarded for it."),
            live(9, "Truncated", "ULINT", Live.STATION_DISCARDED_TRUNCATED,
                 "Frames discarded for it."),
            live(10, "Count too large", "ULINT", Live.STATION_DISCARDED_COUNT_TOO_LARGE,
                 "Frames discarded for it."),
            live(11, "Wrong type", "ULINT", Live.STATION_DISCARDED_WRONG_TYPE,
                 "Frames discarded for it."),
            live(12, "Too many requests", "ULINT", Live.STATION_DISCARDED_TOO_MANY_REQUESTS,
                 "Requests left without an answer."),
            live(13, "No sender", "ULINT", Live.STATION_DISCARDED_NO_SENDER,
                 "Requests that do not tell whom to answer.")),
    _single(0xF200, "EAP control", "What the device is asked to do.",
            EntryRow(1, "Requested state", "UINT", RW, "2 PreOp, 4 SafeOp, 8 Op; the status says "
                     "what came of it.")),
    _single(0xF800, "Configured objects", "How many there are; counted by the device.",
            *(derived(sub, name, "UINT", Derived.COUNT, "How many exist.")
              for sub, name in enumerate(_KINDS, 1)),
            config(8, "Device cycle time", "UDINT", "Of the station, all its ports alike.",
                   default=10_000, minimum=100, maximum=60_000_000, unit="us"),
            config(9, "Phase", "UDINT", "Where in the cycle the station runs.", unit="us")),
    _single(0xF801, "Free objects", "First free index of each kind; found by the device.",
            *(derived(sub, name, "UINT", Derived.NEXT_FREE, "First free index; 0 none is left.",
                      form=Form.INDEX)
              for sub, name in enumerate(_KINDS, 1))),
    _single(0xF810, "EAP port", "How the port reaches others.",
            fixed(1, "Name", NAME, "In the plant file."),
            fixed(2, "Transport", "USINT", "0 UDP, 1 Ethernet, 2 TCP, 3 loop within the process."),
            fixed(3, "Interface", TEXT, "Such as udp://10.0.0.1 or ethernet://eth0."),
            fixed(4, "Port number", "UINT", "UDP or TCP; 0 is 34980, or there is none."),
            config(5, "VLAN ID", "UINT", "Ethernet: tag of its frames; 0 untagged.", maximum=4094),
            config(6, "VLAN priority", "USINT", "Of the tag.", maximum=7),
            config(7, "TCP", "BOOL", "Whether process data is taken from TCP connections too."),
            config(8, "Broadcast", "BOOL", "UDP: whether broadcasts are listened to."),
            config(9, "Wake", "USINT", "Frames are taken 0 in each cycle, 1 as they arrive.",
                   maximum=1),
            config(10, "EAP SM", "BOOL", "Whether the frames it sends carry the device's state.")),
    _single(0xF811, "Multicast groups", "Groups to listen to besides the EAP default.",
            EntryRow(1, "Group {n}", "STRING(17)", CONFIG, "MAC address on Ethernet, IPv4 on UDP; "
                     "empty none.", last=MAX_ENTRIES)),
    _single(0xF920, "AoE NetID", "Of this port.",
            fixed(1, "NetID", "BLOCK(6)", "", form=Form.NET_ID)),
)  # fmt: skip

DYNAMIC = (RX_PDO, TX_PDO, MORE_RX_PDO, MORE_TX_PDO, TX_VARIABLE, RX_VARIABLE,
           TX_FRAME, TX_PD, RX_PD)  # fmt: skip
VARIABLES = (TX_VARIABLE, RX_VARIABLE)
MAPPINGS = (RX_PDO, TX_PDO, MORE_RX_PDO, MORE_TX_PDO)
COMPANIONS = (FRAME_DIAGNOSIS, TX_DIAGNOSIS, RX_DIAGNOSIS)
STATIC = (*IDENTITY, *DEVICE)
ALL = tuple(sorted((*STATIC, *DYNAMIC, *COMPANIONS), key=lambda row: row.first))

_BY_PAGE = {
    page: [row for row in ALL if row.first >> 8 <= page <= row.last >> 8] for page in range(0x100)
}


def find(index: int) -> ObjectRange | None:
    """Return what the profile has at *index*, None if nothing."""
    for row in _BY_PAGE[index >> 8]:
        if row.first <= index <= row.last:
            return row
    return None


def row_of(index: int) -> ObjectRange:
    """Return what the profile has at *index*, of an object that exists."""
    row = find(index)
    if row is None:
        raise LookupError(f"the profile has nothing at 0x{index:04X}")
    return row
