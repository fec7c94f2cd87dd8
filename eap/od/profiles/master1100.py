"""The EtherCAT master: modular device profile 5001, sub-profile 1100 (ETG.1510, ETG.5001.3).

Slave n has three objects: what is configured (0x8000 + n), what was found (0x9000 + n), and how it
is (0xA000 + n).  Masters differ in how far these reach; the usual extent ends where they all agree,
also on the padding of complete access.
"""

from __future__ import annotations

from enum import StrEnum, auto

from eap.od.model import RW, ObjectCode
from eap.od.profiles.eap1000 import identity
from eap.od.profiles.table import ProfileEntry, ProfileObject, fixed, live, single

MODULE_PROFILE = 1100
MAX_SLAVES = 4080
PER_LIST = 255
"""Addresses in one object of 0xF020 or 0xF040."""

_RECORD, _ARRAY = ObjectCode.RECORD, ObjectCode.ARRAY


class MasterLive(StrEnum):
    """Keys of live entries, of the master or of the slave of the object."""

    ADDRESS = auto()
    TYPE = auto()
    NAME = auto()
    DEVICE_TYPE = auto()
    VENDOR = auto()
    PRODUCT = auto()
    REVISION = auto()
    SERIAL = auto()
    MAILBOX_OUT = auto()
    MAILBOX_IN = auto()
    LINK_STATUS = auto()
    LINK_PRESET = auto()
    FLAGS = auto()
    PHYSICS = auto()
    PROTOCOLS = auto()
    HAS_HISTORY = auto()
    DL_STATUS = auto()
    AL_STATUS = auto()
    AL_CONTROL = auto()
    AL_STATUS_CODE = auto()
    LINK_CONNECTION = auto()
    LINK_CONTROL = auto()
    NEIGHBOUR_0 = auto()
    NEIGHBOUR_1 = auto()
    NEIGHBOUR_2 = auto()
    NEIGHBOUR_3 = auto()
    CRC_0 = auto()
    CRC_1 = auto()
    CRC_2 = auto()
    CRC_3 = auto()
    WKC_ERRORS = auto()
    ABSENCES = auto()
    ABNORMAL_CHANGES = auto()
    FIXED_LINKS = auto()
    LAST_PROTOCOL_ERROR = auto()
    HAS_NEW_DIAGNOSIS = auto()
    DETECT_REQUEST = auto()
    DETECT_STATUS = auto()
    DETECT_RESPONSE = auto()
    LOST_CYCLIC = auto()
    LOST_ACYCLIC = auto()
    RATE_CYCLIC = auto()
    RATE_ACYCLIC = auto()
    STATE = auto()
    RESET = auto()


def _writable(row: ProfileEntry) -> ProfileEntry:
    return row._replace(access=RW)


CONFIGURED = ProfileObject(
    0x8000, 0x8FEF, "Configuration data slave {n}", _RECORD,
    (
        live(1, "Fixed station address", "UINT", MasterLive.ADDRESS, "ESC register 0x0010."),
        live(2, "Type", "STRING(16)", MasterLive.TYPE, "Order code of the EEPROM."),
        live(3, "Name", "STRING(32)", MasterLive.NAME, "Of the slave, as it was given."),
        live(4, "Device type", "UDINT", MasterLive.DEVICE_TYPE,
             "Object 0x1000 of the slave; 0 unknown."),
        live(5, "Vendor ID", "UDINT", MasterLive.VENDOR, "Configured."),
        live(6, "Product code", "UDINT", MasterLive.PRODUCT, "Configured."),
        live(7, "Revision number", "UDINT", MasterLive.REVISION, "Configured."),
        live(8, "Serial number", "UDINT", MasterLive.SERIAL, "Configured."),
        live(33, "Mailbox out size", "UINT", MasterLive.MAILBOX_OUT, "Bytes, to the slave."),
        live(34, "Mailbox in size", "UINT", MasterLive.MAILBOX_IN, "Bytes, from the slave."),
        live(35, "Link status", "USINT", MasterLive.LINK_STATUS, "Bit 0 no link, 1 link without "
             "communication, 2 link missing, 3 additional link, 4 to 7 the ports concerned."),
        live(36, "Link preset", "USINT", MasterLive.LINK_PRESET,
             "Bits 0 to 2: ports 1 to 3 expect a "
             "neighbour; bits 4 to 6: ports 1 to 3 expect a link."),
        live(37, "Flags", "USINT", MasterLive.FLAGS, "Bits 0 to 1 redundancy port, 2 head of a "
             "hot-connect group, 3 member of one."),
        live(38, "Port physics", "UINT", MasterLive.PHYSICS,
             "Four bits for each port: 0 none, 1 MII, "
             "3 EBUS."),
        live(39, "Mailbox protocols", "UINT", MasterLive.PROTOCOLS,
             "Bits of the EEPROM: AoE 1, EoE 2, "
             "CoE 4, FoE 8, SoE 16, VoE 32."),
        live(40, "Diagnosis history", "BOOL", MasterLive.HAS_HISTORY,
             "Whether the slave has object "
             "0x10F3."),
    ),
    "A slave of the configuration, in the order of the bus.",
)  # fmt: skip
DETECTED = ProfileObject(
    0x9000, 0x9FEF, "Information data slave {n}", _RECORD,
    (
        live(1, "Fixed station address", "UINT", MasterLive.ADDRESS, "ESC register 0x0010."),
        live(5, "Vendor ID", "UDINT", MasterLive.VENDOR, "Found."),
        live(6, "Product code", "UDINT", MasterLive.PRODUCT, "Found."),
        live(7, "Revision number", "UDINT", MasterLive.REVISION, "Found."),
        live(8, "Serial number", "UDINT", MasterLive.SERIAL, "Found."),
        live(32, "DL status", "UINT", MasterLive.DL_STATUS, "ESC register 0x0110."),
    ),
    "A slave that the last scan has found, in the order of the bus.",
)  # fmt: skip
DIAGNOSIS = ProfileObject(
    0xA000, 0xAFEF, "Diagnosis data slave {n}", _RECORD,
    (
        live(1, "AL status", "UINT", MasterLive.AL_STATUS, "ESC register 0x0130."),
        _writable(live(2, "AL control", "UINT", MasterLive.AL_CONTROL,
                  "Writing it requests a state.")),
        live(3, "Last AL status code", "UINT", MasterLive.AL_STATUS_CODE,
             "The latest that was not 0."),
        live(4, "Link connection status", "USINT", MasterLive.LINK_CONNECTION,
             "Bits 0 to 3: ports that "
             "communicate; bits 4 to 7: ports with a link."),
        _writable(live(5, "Link control", "USINT", MasterLive.LINK_CONTROL,
                  "Two bits for each port: 0 "
             "auto, 1 auto close, 2 always open, 3 always closed.")),
        live(6, "Fixed address port 0", "UINT", MasterLive.NEIGHBOUR_0,
             "Of the slave connected there."),
        live(7, "Fixed address port 1", "UINT", MasterLive.NEIGHBOUR_1,
             "Of the slave connected there."),
        live(8, "Fixed address port 2", "UINT", MasterLive.NEIGHBOUR_2,
             "Of the slave connected there."),
        live(9, "Fixed address port 3", "UINT", MasterLive.NEIGHBOUR_3,
             "Of the slave connected there."),
        live(10, "Frame errors port 0", "UDINT", MasterLive.CRC_0, "Damaged frames."),
        live(11, "Frame errors port 1", "UDINT", MasterLive.CRC_1, "Damaged frames."),
        live(12, "Frame errors port 2", "UDINT", MasterLive.CRC_2, "Damaged frames."),
        live(13, "Frame errors port 3", "UDINT", MasterLive.CRC_3, "Damaged frames."),
        live(14, "Working counter errors", "UDINT", MasterLive.WKC_ERRORS,
             "Of cyclic frames, of the "
             "whole bus: a working counter does not name a slave."),
        live(15, "Slave not present", "UDINT", MasterLive.ABSENCES,
             "How often it did not answer any "
             "more."),
        live(16, "Abnormal state changes", "UDINT", MasterLive.ABNORMAL_CHANGES,
             "How often it left its "
             "state by itself."),
        _writable(live(17, "Disable automatic link control", "BOOL", MasterLive.FIXED_LINKS,
                  "Whether "
             "ports stay as link control says.")),
        live(18, "Last protocol error", "UDINT", MasterLive.LAST_PROTOCOL_ERROR, "Of its mailbox."),
        live(19, "New diagnosis message", "BOOL", MasterLive.HAS_NEW_DIAGNOSIS,
             "Whether object 0x10F3 "
             "has one."),
    ),
    "How a slave is.",
)  # fmt: skip
# TwinCAT stops before the entries where masters and clients pad complete access differently.
USUAL_EXTENT = {CONFIGURED.first: 37, DETECTED.first: 32, DIAGNOSIS.first: 17}
"""Last sub-index by first index of the range, as TwinCAT has it."""
FIXED = (
    *identity(MODULE_PROFILE),
    single(0xF000, "Modular device profile", "How the objects are numbered.",
           fixed(1, "Module index distance", "UINT", "Between two slaves.", default=1),
           fixed(2, "Maximum number of modules", "UINT", "Slaves.", default=MAX_SLAVES),
           # The values that IgH and libethercat answer with.
           fixed(3, "Available entries in 0x8nnn", "UDINT", "One bit for each of the first.",
                 default=0xFF),
           fixed(4, "Available entries in 0x9nnn", "UDINT", "One bit for each of the first.",
                 default=0xF1)),
    single(0xF002, "Detect modules command", "Scans the bus.",
           _writable(live(1, "Command request", "BLOCK(2)", MasterLive.DETECT_REQUEST, "Writing it "
                          "starts a scan.")),
           live(2, "Command status", "USINT", MasterLive.DETECT_STATUS,
                "0 none yet, 1 done, 3 failed, "
                "255 busy."),
           live(3, "Command response", "BLOCK(6)", MasterLive.DETECT_RESPONSE,
                "Status, 0, vendor's "
                "error, number of slaves.")),
    single(0xF120, "Master diag data", "Frames of the whole bus.",
           live(1, "Cyclic lost frames", "UDINT", MasterLive.LOST_CYCLIC, "Since the last reset."),
           live(2, "Acyclic lost frames", "UDINT", MasterLive.LOST_ACYCLIC,
                "Since the last reset."),
           live(3, "Cyclic frames per second", "UDINT", MasterLive.RATE_CYCLIC, "Now."),
           live(4, "Acyclic frames per second", "UDINT", MasterLive.RATE_ACYCLIC, "Now."),
           live(16, "Master state", "UINT", MasterLive.STATE, "1 Init, 2 PreOp, 4 SafeOp, 8 Op.")),
    single(0xF200, "Diag interface control", "Resets counters.",
           _writable(live(16, "Reset diag info", "BOOL", MasterLive.RESET, "A rising edge sets the "
                          "counters of 0xAnnn and 0xF120 to 0."))),
)  # fmt: skip
CONFIGURED_LIST = ProfileObject(
    0xF020, 0xF02F, "Configured address list {n}", _ARRAY,
    (fixed(1, "Subindex {n:03}", "UINT", "Station address.", last=PER_LIST),),
    "Station addresses of the configuration, 255 in each object.",
)  # fmt: skip
DETECTED_LIST = CONFIGURED_LIST._replace(
    first=0xF040,
    last=0xF04F,
    name="Detected address list {n}",
    description="Station addresses that the last scan has found, 255 in each object.",
)
SLAVES = (CONFIGURED, DETECTED, DIAGNOSIS)
LISTS = (CONFIGURED_LIST, DETECTED_LIST)
ALL = tuple(sorted((*FIXED, *SLAVES, *LISTS), key=lambda row: row.first))
