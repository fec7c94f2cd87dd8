"""The EAP device: modular device profile 5001, sub-profile 1000 (ETG.5001, ETG.1005).

The ranges, the meaning of the objects and the sub-indexes 3, 4 and 6 of process data come from
descriptions of the profile; the rest of the sub-index tables is ours, as no public document has
them.  Clients find everything by name through SDO information.

To add a field of the plant file: its section (``eap.config.structs``) and its record
(``eap.pd.spec``) get it, a row here names both, and docs/plant-file.md explains it; dictionaries,
checks of entries, plans and docs/objects.md follow.  A TxFrame ends with the list of its PDs:
sub-index 0, the highest sub-index, gives the length of the list, so that nothing can follow it.  A
new entry takes the first sub-index of the list, and the list moves up by one.  A script that writes
the list by number then writes another entry: CHANGELOG.md names it.  Stored objects are then those
of another version (``eap.device.configuration.VERSION``), and are made anew from the stored
specification.
"""

from __future__ import annotations

from enum import IntEnum

from eap.ids import DestinationKind
from eap.od.model import RO, RW, Access, ObjectCode
from eap.od.profiles.eap1000_keys import Derived, EapLive
from eap.od.profiles.table import (
    OWN_TYPE,
    Form,
    ProfileEntry,
    ProfileObject,
    Rule,
    config,
    derived,
    field_rows,
    fixed,
    live,
    setting,
    single,
)

# The vendor's description of its own EAP device says 5002.
PROFILE = 5001
"""Of modular devices."""
MODULE_PROFILE = 1000


class Var(IntEnum):
    """0x6000 and 0x7000: a variable."""

    VALUE = 1
    BIT_LENGTH = 2
    DATA_TYPE = 3
    TYPE_NAME = 4
    NAME = 5
    UNIT = 6
    COMMENT = 7
    DEFAULT_GIVEN = 8
    DEFAULT = 9
    WRITER = 10


class FrameSub(IntEnum):
    """0x8000: a TxFrame."""

    ENABLED = 1
    ADDRESS_MODE = 2
    DESTINATION_MAC = 3
    DESTINATION_NETID = 4
    DESTINATION_IP = 5
    PORT_NUMBER = 6
    MONITORING_INTERVAL = 7
    FRAME_STATE = 8
    NAME = 9
    DIVIDER = 10
    MODULO = 11
    MONITOR_IP = 12
    CHANGEABLE = 13
    FRAME_CONTROL = 14
    FRAME_LENGTH = 15
    SIGN = 16
    TXPD = 17


class Tx(IntEnum):
    """0xD000: a TxPD."""

    PDO_INDEX = 1
    PDO_LENGTH = 2
    PD_ID = 3
    VERSION = 4
    ENABLED = 5
    PUBLISHER = 6
    CYCLE_TIME = 7
    DIVIDER = 8
    MODULO = 9
    POLL_REQUEST_RXPD = 10
    ON_CHANGE_TIMEOUT = 11
    ON_CHANGE_INHIBIT = 12
    VARSTATE = 13
    NAME = 14
    ON_CHANGE = 15
    EVENT = 16
    CHANGEABLE = 17
    VARCTRL = 18


class Rx(IntEnum):
    """0xE000: an RxPD."""

    PDO_INDEX = 1
    PDO_LENGTH = 2
    PD_ID = 3
    VERSION = 4
    # ID and length are never ignored: another PD's data would be taken for this one's.
    FLAGS = 5
    PUBLISHER = 6
    POLL_REQUEST_TXPD = 7
    QUALITY = 8
    CYCLE_INDEX = 9
    VARSTATE = 10
    NAME = 11
    TIME_OUT = 12
    SUBSTITUTE = 13
    SENDER_CYCLE = 14
    STEP = 15
    CHANGEABLE = 16
    STATE = 17
    SOURCE = 18
    AUTHENTICATION = 19


class Status(IntEnum):
    """0xF100: where the device stands."""

    STATE = 1
    ERROR_CODE = 2
    ERROR_TEXT = 3
    ERROR_OBJECT = 4


class Configured(IntEnum):
    """0xF800: how many objects there are, and the device's times."""

    TXFRAMES = 1
    TXPDS = 2
    RXPDS = 3
    TXPDOS = 4
    RXPDOS = 5
    TX_VARIABLES = 6
    RX_VARIABLES = 7
    DEVICE_CYCLE_TIME = 8
    PHASE = 9


class PortSub(IntEnum):
    """0xF810: the port itself."""

    NAME = 1
    TRANSPORT = 2
    INTERFACE = 3
    PORT_NUMBER = 4
    VLAN_ID = 5
    VLAN_PRIORITY = 6
    TCP = 7
    BROADCAST = 8
    WAKE = 9
    EAP_SM = 10
    LENGTH = 11


class AddressMode(IntEnum):
    """Form of the destination of a TxFrame."""

    MAC = 0
    NET_ID = 1
    IP = 2
    TCP = 3
    REQUESTER = 4

    @property
    def kind(self) -> DestinationKind | None:
        """Kind of the address; None of the requester's."""
        return None if self is AddressMode.REQUESTER else DestinationKind[self.name]


class RxFlag(IntEnum):
    """Bits of an RxPD's flags."""

    IGNORE_NETID = 0x01
    IGNORE_VERSION = 0x04
    ENABLED = 0x80


class WrittenBy(IntEnum):
    """Writer of a Tx variable."""

    APPLICATION = 0
    ENGINE = 1
    SERVICES = 2


class Substituted(IntEnum):
    """Content of the variables of an RxPD after its time-out."""

    HOLD = 0
    ZERO = 1
    DEFAULT = 2


class Waking(IntEnum):
    """Moment at which a port takes frames."""

    CYCLE = 0
    ARRIVAL = 1


class Authenticated(IntEnum):
    """Treatment of the signature of frames with a PD."""

    OFF = 0
    COUNT = 1
    REQUIRED = 2


class LengthChecked(IntEnum):
    """Treatment of frames with a wrong Length."""

    STRICT = 0
    LENIENT = 1


NAME = "STRING(255)"
TEXT = "STRING(1000)"
# 255 is reserved for the object's structure.
MAX_ENTRIES = 254
"""Highest sub-index of a list."""
WHOLE = 0xFF
"""Bit length in a mapping entry of a variable too long for the eight bits there."""

_RECORD, _ARRAY, _VAR = ObjectCode.RECORD, ObjectCode.ARRAY, ObjectCode.VAR

_VARIABLE = (
    derived(Var.BIT_LENGTH, "Bit length", "UDINT", Derived.BIT_LENGTH, "Bits that travel."),
    derived(Var.DATA_TYPE, "Data type", "UINT", Derived.TYPE_CODE, "Index of the base type."),
    # As long as an entry description can say: a struct's text has all its members.
    setting(Var.TYPE_NAME, "Type name", "STRING(8191)", "Such as UINT, REAL[4] or BLOCK(600).",
            default="UINT", key="type", rule=Rule.TYPE),
    config(Var.NAME, "Name", NAME, "Unique in the station.", field="name", rule=Rule.NAME),
    setting(Var.UNIT, "Unit", NAME, "Text for operators.", key="unit"),
    setting(Var.COMMENT, "Comment", TEXT, "Text for operators.", key="comment"),
    config(Var.DEFAULT_GIVEN, "Default given", "BOOL",
           "Whether the next entry counts; else it starts as zero."),
    config(Var.DEFAULT, "Default", OWN_TYPE, "Value at the start, and as a substitute.",
           key="default", rule=Rule.DEFAULT),
)  # fmt: skip
_VALUE = ProfileEntry(
    1, "Value", OWN_TYPE, RO, "As it lies in the process image.", live=EapLive.VALUE.value
)
TX_VARIABLE = ProfileObject(
    0x6000, 0x6FFF, "Tx variable {n}", _RECORD,
    (
        _VALUE._replace(access=RO | Access.TX_MAPPABLE),
        *_VARIABLE,
        config(Var.WRITER, "Writer", "USINT",
               "0 user programs, 1 the cycle, 2 measurements and files.", maximum=2,
               field="writer", words=WrittenBy),
    ),
    "A variable that can be sent; its value travels, in the order of the PDO. One that another "
    "port or a bus of the station has by the same name is that one, and described alike.",
    dynamic=True, section="variables",
)  # fmt: skip
RX_VARIABLE = ProfileObject(
    0x7000, 0x7FFF, "Rx variable {n}", _RECORD,
    (_VALUE._replace(access=RO | Access.TX_MAPPABLE | Access.RX_MAPPABLE), *_VARIABLE),
    "A variable that is received; it may be sent on.", dynamic=True,
    section="subscribe.variables",
)  # fmt: skip

_MAPPED = (
    config(1, "Mapping {n}", "UDINT", "Index, sub-index and bit length (16, 8, 8 bits); index 0 "
           "is padding, bit length 255 the whole of a longer variable.", last=MAX_ENTRIES,
           form=Form.MAPPING, key="variables"),
)  # fmt: skip
RX_PDO = ProfileObject(
    0x1600, 0x17FF, "RxPDO mapping {n}", _ARRAY, _MAPPED,
    "Variables of a received PD in their order.", dynamic=True, mapping=True, section="subscribe",
)  # fmt: skip
TX_PDO = ProfileObject(
    0x1A00, 0x1BFF, "TxPDO mapping {n}", _ARRAY, _MAPPED,
    "Variables of a sent PD in their order.", dynamic=True, mapping=True, section="publish",
)  # fmt: skip
# The 512 indexes of the standard are too few for 1,000 PDs.
MORE_RX_PDO = RX_PDO._replace(
    first=0x2000, last=0x2DFF, name="Further RxPDO mapping {n}",
    description="As 0x1600, for ports that receive more than 512 different PDOs.",
)  # fmt: skip
MORE_TX_PDO = TX_PDO._replace(
    first=0x3000, last=0x3DFF, name="Further TxPDO mapping {n}",
    description="As 0x1A00, for ports that send more than 512 different PDOs.",
)  # fmt: skip

TX_FRAME = ProfileObject(
    0x8000, 0x8FFF, "TxFrame {n}", _RECORD,
    (
        config(FrameSub.ENABLED, "Enabled", "BOOL",
               "A frame that is not is left alone altogether."),
        config(FrameSub.ADDRESS_MODE, "Address mode", "USINT",
               "0 MAC, 1 NetID, 2 IP by UDP, 3 IP by TCP, 4 the requester of its PDs.",
               maximum=4, changeable=True, key="to"),
        config(FrameSub.DESTINATION_MAC, "Destination MAC", "BLOCK(6)",
               "Address mode 0; in mode 1 that of the NetID, and all zero or a group if it is to "
               "be learned.", default=bytes.fromhex("010105040000"), form=Form.MAC,
               changeable=True, key="to"),
        config(FrameSub.DESTINATION_NETID, "Destination NetID", "BLOCK(6)", "Address mode 1.",
               form=Form.NET_ID, changeable=True, key="to"),
        config(FrameSub.DESTINATION_IP, "Destination IP", "BLOCK(4)",
               "Address modes 2 and 3, first byte first.", form=Form.IP, changeable=True,
               key="to"),
        config(FrameSub.PORT_NUMBER, "Port number", "UINT", "UDP or TCP; 0 is 34980.",
               changeable=True, key="to"),
        setting(FrameSub.MONITORING_INTERVAL, "Monitoring interval", "UDINT",
                "How often to look whether the subscriber is there; 0 never.", unit="ms",
                key="monitor_interval_ms"),
        live(FrameSub.FRAME_STATE, "Frame state", "UINT", EapLive.FRAME_STATE,
             "Bit 0 not sent, bit 1 too long, bit 2 subscriber missing."),
        setting(FrameSub.NAME, "Name", NAME, "Unique among the station's frames.", key="name",
                rule=Rule.NAME),
        setting(FrameSub.DIVIDER, "Divider", "UINT",
                "Leaves only in cycles whose number, divided by this, leaves the modulo; 0 off.",
                key="divider"),
        setting(FrameSub.MODULO, "Modulo", "UINT", "Less than the divider.", key="modulo"),
        setting(FrameSub.MONITOR_IP, "Monitor IP", "BLOCK(4)",
                "Host to probe for on Ethernet; all zero none.", form=Form.IP, key="monitor_ip"),
        setting(FrameSub.CHANGEABLE, "Changeable", "BOOL",
                "Whether the destination may be written in SafeOp and Op.", key="changeable"),
        live(FrameSub.FRAME_CONTROL, "Frame control", "UINT", EapLive.FRAME_CTRL,
             "Bit 0 suppresses the frame."),
        derived(FrameSub.FRAME_LENGTH, "Frame length", "UINT", Derived.FRAME_LENGTH,
                "Bytes with all its PDs."),
        setting(FrameSub.SIGN, "Sign", "BOOL",
                "Whether a last PD signs it with a key of the station.", key="sign"),
        config(FrameSub.TXPD, "TxPD {n}", "UINT", "Index of a PD that it carries; 0 none.",
               last=MAX_ENTRIES, form=Form.INDEX, refers=(0xD000,)),
    ),
    "One frame to send: where it goes and what is in it.", dynamic=True, companion=0xA000,
    section="frames",
)  # fmt: skip
FRAME_DIAGNOSIS = ProfileObject(
    0xA000, 0xAFFF, "TxFrame diagnosis {n}", _RECORD,
    (
        live(1, "Sent whole", "ULINT", EapLive.FRAME_WHOLE, "With all PDs by the same schedule."),
        live(2, "Sent otherwise", "ULINT", EapLive.FRAME_PARTIAL, "With some of its PDs."),
        live(3, "Skipped", "ULINT", EapLive.FRAME_SKIPPED,
             "Suppressed, or refused by the network."),
    ),
    "What became of the TxFrame of the same number.",
)  # fmt: skip
TX_PD = ProfileObject(
    0xD000, 0xDFFF, "TxPD {n}", _RECORD,
    (
        config(Tx.PDO_INDEX, "PDO index", "UINT",
               "Mapping that it carries (0x1A00 or 0x3000 on); 0 none.", form=Form.INDEX,
               refers=(0x1A00, 0x3000)),
        derived(Tx.PDO_LENGTH, "PDO length", "UINT", Derived.PDO_LENGTH, "Bytes of data."),
        setting(Tx.PD_ID, "PD ID", "UINT", "Unique per publisher.", changeable=True, key="id",
                field="pd_id"),
        setting(Tx.VERSION, "Version", "UINT", "Of the layout; subscribers discard others.",
                key="version"),
        config(Tx.ENABLED, "Enabled", "BOOL", "A PD that is not is left out of its frame."),
        fixed(Tx.PUBLISHER, "Publisher", "BLOCK(6)", "NetID of this port.", form=Form.NET_ID),
        setting(Tx.CYCLE_TIME, "Cycle time", "UDINT",
                "Whole multiple of the device cycle; 0 off.", unit="us", key="cycle_us",
                field="trigger.cycle_us"),
        setting(Tx.DIVIDER, "Divider", "UINT",
                "Sent in cycles whose number, divided by this, leaves the modulo; 0 off.",
                key="divider", field="trigger.divider"),
        setting(Tx.MODULO, "Modulo", "UINT", "Less than the divider.", key="modulo",
                field="trigger.modulo"),
        setting(Tx.POLL_REQUEST_RXPD, "Poll request RxPD", "UINT",
                "Sent as the answer to this RxPD; 0 none.", form=Form.INDEX, changeable=True,
                key="poll", field="poll_request", refers=(0xE000,)),
        setting(Tx.ON_CHANGE_TIMEOUT, "On change timeout", "UDINT",
                "Sent again though unchanged; 0 never. Other than 0 it switches sending on change "
                "on.", unit="ms", key="on_change.timeout_ms",
                field="trigger.on_change.timeout_ms"),
        setting(Tx.ON_CHANGE_INHIBIT, "On change inhibit", "UDINT",
                "Shortest gap between two changes; 0 none. Other than 0 it switches sending on "
                "change on.", unit="us", key="on_change.inhibit_us",
                field="trigger.on_change.inhibit_us"),
        live(Tx.VARSTATE, "VarState", "UINT", EapLive.TX_VAR_STATE, "Bit 0 not sent."),
        setting(Tx.NAME, "Name", NAME, "Unique among the station's sent PDs.", key="name",
                rule=Rule.NAME),
        config(Tx.ON_CHANGE, "On change", "BOOL",
               "Sent when the data differs from what was sent last.", key="on_change"),
        setting(Tx.EVENT, "Event", "BOOL", "Sent when bit 1 of its VarCtrl rises.", key="event",
                field="trigger.event"),
        setting(Tx.CHANGEABLE, "Changeable", "BOOL",
                "Whether PD ID and poll request may be written in SafeOp and Op.",
                key="changeable"),
        live(Tx.VARCTRL, "VarCtrl", "UINT", EapLive.TX_VAR_CTRL,
             "Bit 0 suppresses the PD, bit 1 sends it."),
    ),
    "One PD to send: which PDO, and when.", dynamic=True, companion=0xB000, section="publish",
)  # fmt: skip
TX_DIAGNOSIS = ProfileObject(
    0xB000, 0xBFFF, "TxPD diagnosis {n}", _RECORD,
    (
        live(1, "Last reason", "USINT", EapLive.TX_LAST_REASON,
             "Of the entries 3 to 8: 0 the first."),
        live(2, "Skipped", "ULINT", EapLive.TX_SKIPPED, "Due, but suppressed."),
        live(3, "Sent by cycle", "ULINT", EapLive.TX_SENT_CYCLE, "In its own rhythm."),
        live(4, "Sent by divider", "ULINT", EapLive.TX_SENT_DIVIDER, "Its own, or its frame's."),
        live(5, "Sent on change", "ULINT", EapLive.TX_SENT_CHANGE, "Since the start."),
        live(6, "Sent unchanged", "ULINT", EapLive.TX_SENT_CHANGE_TIMEOUT, "After the timeout."),
        live(7, "Sent on event", "ULINT", EapLive.TX_SENT_EVENT, "Since the start."),
        live(8, "Sent on request", "ULINT", EapLive.TX_SENT_POLL, "As an answer."),
    ),
    "Why the TxPD of the same number was sent.",
)  # fmt: skip
RX_PD = ProfileObject(
    0xE000, 0xEFFF, "RxPD {n}", _RECORD,
    (
        config(Rx.PDO_INDEX, "PDO index", "UINT",
               "Mapping that takes it (0x1600 or 0x2000 on); 0 none.", form=Form.INDEX,
               refers=(0x1600, 0x2000)),
        derived(Rx.PDO_LENGTH, "PDO length", "UINT", Derived.PDO_LENGTH, "Bytes of data."),
        setting(Rx.PD_ID, "PD ID", "UINT", "Expected ID.", changeable=True, key="from.id",
                field="pd_id"),
        setting(Rx.VERSION, "Version", "UINT", "Expected version of the layout.", key="version"),
        config(Rx.FLAGS, "Flags", "USINT", "Bit 7 enabled; bit 0: the NetID is ignored, bit 2: the "
               "version is. ID and length never are: bits 1 and 3 are 0.", form=Form.HEX,
               key="ignore_version", rule=Rule.FLAGS),
        setting(Rx.PUBLISHER, "Publisher", "BLOCK(6)", "NetID of the sender; all zero is any.",
                form=Form.NET_ID, changeable=True, key="from.publisher", field="publisher"),
        setting(Rx.POLL_REQUEST_TXPD, "Poll request TxPD", "UINT",
                "The TxPD that this one answers; 0 none.", form=Form.INDEX, changeable=True,
                key="poll", field="poll_request", refers=(0xD000,)),
        live(Rx.QUALITY, "Quality", "UINT", EapLive.RX_QUALITY, "Age of the data.", unit="100 us"),
        live(Rx.CYCLE_INDEX, "Cycle index", "UINT", EapLive.RX_CYCLE_INDEX,
             "Cycle counter of the sender."),
        live(Rx.VARSTATE, "VarState", "UINT", EapLive.RX_VAR_STATE,
             "Last one refused for: bit 0 version, bit 1 length."),
        setting(Rx.NAME, "Name", NAME, "Unique among the station's received PDs.", key="name",
                rule=Rule.NAME),
        setting(Rx.TIME_OUT, "Time-out", "UDINT", "Age at which the substitute applies; 0 never.",
                unit="ms", key="timeout_ms"),
        setting(Rx.SUBSTITUTE, "Substitute", "USINT",
                "0 hold the last values, 1 zero, 2 the defaults.", maximum=2, key="substitute",
                words=Substituted),
        setting(Rx.SENDER_CYCLE, "Sender cycle", "UDINT",
                "Device cycle of the sender; 0 unknown.", unit="us", key="from.cycle_us",
                field="sender_cycle_us"),
        setting(Rx.STEP, "Step", "UDINT",
                "Sender cycles between two of this PD; 0 no fixed step.", key="from.step",
                field="step"),
        setting(Rx.CHANGEABLE, "Changeable", "BOOL",
                "Whether PD ID, NetID and poll request may be written in SafeOp and Op.",
                key="changeable"),
        live(Rx.STATE, "State", "USINT", EapLive.RX_STATE, "0 waiting, 1 running, 2 stale."),
        setting(Rx.SOURCE, "Source", "STRING(40)",
                "Address that its frames must come from: MAC on Ethernet, else IPv4; empty any. "
                "Writing another publisher empties it.", changeable=True, key="source",
                rule=Rule.SOURCE),
        setting(Rx.AUTHENTICATION, "Authentication", "USINT",
                "Of its frames: 0 not looked at, 1 counted, 2 required.", maximum=2, key="auth",
                words=Authenticated),
    ),
    "One PD to receive: its sender, and its PDO.", dynamic=True, companion=0xC000,
    section="subscribe",
)  # fmt: skip
RX_DIAGNOSIS = ProfileObject(
    0xC000, 0xCFFF, "RxPD diagnosis {n}", _RECORD,
    (
        live(1, "Received", "ULINT", EapLive.RX_RECEIVED, "PDs taken."),
        live(2, "Lost", "ULINT", EapLive.RX_LOST, "Told from the cycle counter."),
        live(3, "Duplicated", "ULINT", EapLive.RX_DUPLICATED, "Came twice."),
        live(4, "Reordered", "ULINT", EapLive.RX_REORDERED, "Came behind a later one."),
        live(5, "Late", "ULINT", EapLive.RX_LATE, "Came, but not in time."),
        live(6, "Time-outs", "ULINT", EapLive.RX_TIMEOUTS, "How often the substitute applied."),
        live(7, "Largest jitter", "UDINT", EapLive.RX_JITTER_MAX, "Since the start.", unit="us"),
        live(8, "Wrong version", "ULINT", EapLive.RX_DISCARDED_VERSION, "Discarded for it."),
        live(9, "Wrong length", "ULINT", EapLive.RX_DISCARDED_LENGTH, "Discarded for it."),
        live(10, "Not in Op", "ULINT", EapLive.RX_DISCARDED_SUPPRESSED, "Discarded for it."),
        live(11, "Stale", "ULINT", EapLive.RX_DISCARDED_STALE,
             "Had waited since before the start."),
        live(12, "Wrong source", "ULINT", EapLive.RX_DISCARDED_WRONG_SOURCE,
             "Discarded for it: came from another address."),
        live(13, "Wrong frame length", "ULINT", EapLive.RX_DISCARDED_WRONG_LENGTH,
             "Taken, though the frame's Length was wrong."),
        live(14, "Repeated", "ULINT", EapLive.RX_REPEATED,
             "Came twice, and so said the toggle bit."),
        live(15, "Unsigned", "ULINT", EapLive.RX_DISCARDED_UNSIGNED,
             "Its frame had no signature."),
        live(16, "Bad tag", "ULINT", EapLive.RX_DISCARDED_BAD_TAG,
             "The signature of its frame was wrong."),
        live(17, "Replayed", "ULINT", EapLive.RX_DISCARDED_REPLAYED,
             "The counter of the signature had not risen."),
    ),
    "What became of the RxPD of the same number.",
)  # fmt: skip

_KINDS = ("TxFrames", "TxPDs", "RxPDs", "TxPDOs", "RxPDOs", "Tx variables", "Rx variables")
COUNTED = ((TX_FRAME,), (TX_PD,), (RX_PD,), (TX_PDO, MORE_TX_PDO), (RX_PDO, MORE_RX_PDO),
           (TX_VARIABLE,), (RX_VARIABLE,))  # fmt: skip
"""The ranges behind sub-indexes 1 to 7 of 0xF800 and 0xF801."""


def identity(module_profile: int) -> tuple[ProfileObject, ...]:
    """Return the objects that name a device of *module_profile*."""
    return (
        single(0x1000, "Device type", "Profile in the low word, module profile in the high one.",
               fixed(0, "Device type", "UDINT", "", default=module_profile << 16 | PROFILE,
                     form=Form.HEX)),
        single(0x1008, "Device name", "Of the product.", fixed(0, "Device name", NAME, "")),
        single(0x1009, "Hardware version", "Of the host.",
               fixed(0, "Hardware version", NAME, "")),
        single(0x100A, "Software version", "Of the product.",
               fixed(0, "Software version", NAME, "")),
        single(0x1018, "Identity", "Vendor, product and device.",
               fixed(1, "Vendor ID", "UDINT", "0: not a member of the ETG."),
               fixed(2, "Product code", "UDINT", "Of the product."),
               fixed(3, "Revision", "UDINT", "Of the product."),
               fixed(4, "Serial number", "UDINT", "Of the device; 0 none.")),
    )  # fmt: skip


DEVICE = (
    single(0xF000, "Modular device profile", "How the objects are numbered.",
           fixed(1, "Index distance", "UINT", "Between two objects of a range.", default=1),
           fixed(2, "Maximum number", "UINT", "Of objects of a kind.", default=0x1000)),
    single(0xF100, "EAP status", "Where the device stands.",
           fixed(1, "State", "UINT", "1 Init, 2 PreOp, 4 SafeOp, 8 Op; bit 4: an error."),
           fixed(2, "Error code", "UINT", "Why the last request was refused; 0 it was not."),
           fixed(3, "Error text", TEXT, "The same in words."),
           fixed(4, "Error object", "UDINT", "Index and sub-index (16, 8 bits, then zero) that "
                 "the error is about; 0 none.", form=Form.HEX)),
    single(0xF110, "Device diagnosis", "Counters of the whole station.",
           live(1, "Cycle", "ULINT", EapLive.STATION_CYCLE, "Device cycles run."),
           live(2, "Overruns", "ULINT", EapLive.STATION_OVERRUNS,
                "Cycles left out, being too late."),
           live(3, "Restarts", "ULINT", EapLive.STATION_RESTARTS, "Of the engine."),
           live(4, "Torn", "ULINT", EapLive.STATION_TORN, "Cycles with half-written variables."),
           live(5, "Largest lateness", "ULINT", EapLive.STATION_LATENESS_MAX, "In nanoseconds."),
           live(6, "Links held", "ULINT", EapLive.STATION_LINKS_HELD, "Values no link could pass."),
           live(7, "Wrong publisher", "ULINT", EapLive.STATION_DISCARDED_WRONG_PUBLISHER,
                 "PDs discarded for it."),
           live(8, "Unknown ID", "ULINT", EapLive.STATION_DISCARDED_UNKNOWN_ID,
                 "PDs discarded for it."),
           live(9, "Truncated", "ULINT", EapLive.STATION_DISCARDED_TRUNCATED,
                 "Frames discarded for it."),
           live(10, "Count too large", "ULINT", EapLive.STATION_DISCARDED_COUNT_TOO_LARGE,
                 "Frames discarded for it."),
           live(11, "Wrong type", "ULINT", EapLive.STATION_DISCARDED_WRONG_TYPE,
                 "Frames discarded for it."),
           live(12, "Too many requests", "ULINT", EapLive.STATION_DISCARDED_TOO_MANY_REQUESTS,
                 "Requests left without an answer."),
           live(13, "No sender", "ULINT", EapLive.STATION_DISCARDED_NO_SENDER,
                 "Requests without an address to answer."),
           live(14, "Wrong frame length", "ULINT", EapLive.STATION_DISCARDED_WRONG_LENGTH,
                 "Frames taken, though their Length was wrong.")),
    single(0xF200, "EAP control", "Requests to the device.",
           ProfileEntry(1, "Requested state", "UINT", RW,
                        "2 PreOp, 4 SafeOp, 8 Op; the status says what came of it.",
                        rule=Rule.STATE)),
    single(0xF800, "Configured objects", "How many there are; counted by the device.",
           *(derived(sub, name, "UINT", Derived.COUNT, "How many exist.")
             for sub, name in enumerate(_KINDS, 1)),
           setting(Configured.DEVICE_CYCLE_TIME, "Device cycle time", "UDINT",
                   "Of the station, all its ports alike.", default=10_000, minimum=100,
                   maximum=60_000_000, unit="us", key="cycle_us"),
           setting(Configured.PHASE, "Phase", "UDINT", "Where in the cycle the station runs.",
                   unit="us", key="phase_us"),
           section="stations"),
    single(0xF801, "Free objects", "First free index of each kind; found by the device.",
           *(derived(sub, name, "UINT", Derived.NEXT_FREE, "First free index; 0 none is left.",
                     form=Form.INDEX)
             for sub, name in enumerate(_KINDS, 1))),
    single(0xF810, "EAP port", "How the port reaches others.",
           fixed(PortSub.NAME, "Name", NAME, "In the plant file.", key="name"),
           fixed(PortSub.TRANSPORT, "Transport", "USINT",
                 "0 UDP, 1 Ethernet, 2 TCP, 3 loop within the process.", key="interface"),
           fixed(PortSub.INTERFACE, "Interface", TEXT,
                 "Such as udp://10.0.0.1 or ethernet://eth0.",
                 key="interface"),
           fixed(PortSub.PORT_NUMBER, "Port number", "UINT",
                 "UDP or TCP; 0 is 34980, or there is none.", key="interface"),
           setting(PortSub.VLAN_ID, "VLAN ID", "UINT", "Ethernet: tag of its frames; 0 untagged.",
                   maximum=4094, key="vlan.id", field="vlan_id", schemes=("ethernet",)),
           setting(PortSub.VLAN_PRIORITY, "VLAN priority", "USINT", "Of the tag.", maximum=7,
                   key="vlan.priority", field="vlan_priority", schemes=("ethernet",)),
           setting(PortSub.TCP, "TCP", "BOOL",
                   "Whether process data is taken from TCP connections too.", key="tcp",
                   schemes=("tcp", "udp")),
           setting(PortSub.BROADCAST, "Broadcast", "BOOL",
                   "UDP: whether broadcasts are listened to.", key="broadcast", schemes=("udp",)),
           setting(PortSub.WAKE, "Wake", "USINT",
                   "Frames are taken 0 in each cycle, 1 as they arrive.", maximum=1, key="wake",
                   words=Waking),
           setting(PortSub.EAP_SM, "EAP SM", "BOOL",
                   "Whether the frames it sends carry the device's state.", key="eap_sm"),
           setting(PortSub.LENGTH, "Length", "USINT",
                   "Frames whose Length is wrong are 0 dropped, 1 taken.", maximum=1,
                   key="length", words=LengthChecked),
           section="ports"),
    single(0xF811, "Multicast groups", "Groups to listen to besides the EAP default.",
           config(1, "Group {n}", "STRING(17)", "MAC address on Ethernet, IPv4 on UDP; empty "
                  "none.", last=MAX_ENTRIES, key="join", rule=Rule.GROUP), section="ports"),
    single(0xF920, "AoE NetID", "Of this port.",
           fixed(1, "NetID", "BLOCK(6)", "", form=Form.NET_ID, key="net_id"), section="ports"),
)  # fmt: skip

DYNAMIC = (RX_PDO, TX_PDO, MORE_RX_PDO, MORE_TX_PDO, TX_VARIABLE, RX_VARIABLE,
           TX_FRAME, TX_PD, RX_PD)  # fmt: skip
VARIABLES = (TX_VARIABLE, RX_VARIABLE)
MAPPINGS = (RX_PDO, TX_PDO, MORE_RX_PDO, MORE_TX_PDO)
COMPANIONS = (FRAME_DIAGNOSIS, TX_DIAGNOSIS, RX_DIAGNOSIS)
STATIC = (*identity(MODULE_PROFILE), *DEVICE)
ALL = tuple(sorted((*STATIC, *DYNAMIC, *COMPANIONS), key=lambda row: row.first))

STATUS = 0xF100
CONTROL = 0xF200
OBJECT_COUNTS = 0xF800
FREE_INDEXES = 0xF801
PORT = 0xF810
GROUPS = 0xF811
NET_ID = 0xF920

FIELDS = {row.first: field_rows(row) for row in ALL}
"""By the first index of their range."""
_BY_PAGE = {
    page: [row for row in ALL if row.first >> 8 <= page <= row.last >> 8] for page in range(0x100)
}


def find(index: int) -> ProfileObject | None:
    """Return the row of the profile at *index*, None if there is none."""
    for row in _BY_PAGE[index >> 8]:
        if row.first <= index <= row.last:
            return row
    return None


def row_of(index: int) -> ProfileObject:
    """Return the row of an existing object at *index*."""
    row = find(index)
    if row is None:
        raise LookupError(f"the profile has nothing at 0x{index:04X}")
    return row
