"""The ADS services: what follows the AMS header, and the result codes.

Beckhoff ADS specification; numbers as in the header AdsDef.h of Beckhoff's open AdsLib.  A request
names a value by index group and index offset; every answer begins with a result of 32 bits.
"""

from __future__ import annotations

from enum import IntEnum

from eap.codec.wire import WireStruct, bit, bits3, bits4, bits6, octets16, u8, u16, u32


class AdsError(IntEnum):
    """Results of a service, and errors of the AMS header, which concern the route to it."""

    NONE = 0x000
    INTERNAL = 0x001
    MAILBOX_FULL = 0x004
    TARGET_PORT = 0x006
    TARGET_MACHINE = 0x007
    COMMAND = 0x008
    PORT_NOT_CONNECTED = 0x00D
    AMS_LENGTH = 0x00E
    NET_ID = 0x00F
    AMS_PORT = 0x018
    TCP_SEND = 0x01A
    HOST_UNREACHABLE = 0x01B
    FRAGMENT = 0x01C
    GENERAL = 0x700
    SERVICE = 0x701
    INDEX_GROUP = 0x702
    INDEX_OFFSET = 0x703
    ACCESS = 0x704
    SIZE = 0x705
    VALUE = 0x706
    NOT_READY = 0x707
    BUSY = 0x708
    CONTEXT = 0x709
    NO_MEMORY = 0x70A
    PARAMETER = 0x70B
    NOT_FOUND = 0x70C
    SYNTAX = 0x70D
    INCOMPATIBLE = 0x70E
    EXISTS = 0x70F
    SYMBOL_NOT_FOUND = 0x710
    SYMBOL_VERSION = 0x711
    STATE = 0x712
    TRANS_MODE = 0x713
    NOTIFICATION_HANDLE = 0x714
    CLIENT_UNKNOWN = 0x715
    NO_MORE_HANDLES = 0x716
    WATCH_SIZE = 0x717
    NOT_INITIALIZED = 0x718
    TIMEOUT = 0x719
    PENDING = 0x71E
    ABORTED = 0x71F
    ARRAY_INDEX = 0x721
    SYMBOL_NOT_ACTIVE = 0x722
    ACCESS_DENIED = 0x723
    CLIENT_TIMEOUT = 0x745

    @classmethod
    def name_of(cls, code: int) -> str:
        """Return the name of a code, or its number for one that nothing here sends."""
        # Devices of others send codes of their own.
        return cls(code).name if code in cls._value2member_map_ else f"0x{code:x}"

    @classmethod
    def words_of(cls, code: int) -> str:
        """Return a code with its meaning, for operators."""
        text = _WORDS.get(code)
        return f"error 0x{code:x} ({text or cls.name_of(code)})" if code else "no error"


_WORDS: dict[int, str] = {
    AdsError.MAILBOX_FULL: "too much waits there already",
    AdsError.TARGET_PORT: "nothing has that AMS port",
    AdsError.TARGET_MACHINE: "no route to that NetID",
    AdsError.HOST_UNREACHABLE: "host unreachable",
    AdsError.SERVICE: "it does not know that service",
    AdsError.ACCESS: "not permitted: read only, protected, or a wrong user or password",
    AdsError.TIMEOUT: "no answer in time",
    AdsError.ACCESS_DENIED: "access rules forbid it",
}


class AdsState(IntEnum):
    """ADSSTATE of AdsDef.h."""

    INVALID = 0
    IDLE = 1
    RESET = 2
    INIT = 3
    START = 4
    RUN = 5
    STOP = 6
    SAVE_CONFIG = 7
    LOAD_CONFIG = 8
    POWER_FAILURE = 9
    POWER_GOOD = 10
    ERROR = 11
    SHUTDOWN = 12
    SUSPEND = 13
    RESUME = 14
    CONFIG = 15
    RECONFIG = 16
    STOPPING = 17
    INCOMPATIBLE = 18
    EXCEPTION = 19


class IndexGroup(IntEnum):
    """Index groups with a meaning of their own.

    Those of a slave are of ETG.1020, AoE; those of symbols and sums of AdsDef.h; those of a master
    and of the I/O server as Beckhoff documents them for TwinCAT; FoE, SoE and VoE as in Ads.h of
    its SDK.  An own group takes a number that none of these sources uses, near its relatives, and
    says "own format".
    """

    ADDRESS = 0x0001
    """Written with offset 3: the NetID of the slave."""
    MASTER_STATE = 0x0003
    """Read at 0x100; written with the wanted state as the offset."""
    SLAVE_COUNT = 0x0006
    SLAVE_ADDRESSES = 0x0007
    SLAVE_STATES = 0x0009
    """Offset: 0 for all slaves, or the address of one."""
    RAW_COMMAND = 0x002C
    """An EtherCAT command for the bus, there and back."""
    SYSTEM_STATE = 0x00F0
    """Of the system service: states, version and platform in 16 bytes."""
    DATA = 0x4040
    """The memory of variables; a symbol gives the address of each."""
    DATA_BITS = 0x4041
    """Bit fields of structs in that memory, offset in bits; own format, near 0x4021 of a PLC."""
    IO_DEVICES = 0x5000
    """And those that follow: plus the id of a device."""
    SYMBOL_HANDLE = 0xF003
    VALUE_BY_NAME = 0xF004
    VALUE_BY_HANDLE = 0xF005
    RELEASE_HANDLE = 0xF006
    SYMBOL_BY_NAME = 0xF007
    SYMBOL_VERSION = 0xF008
    SYMBOL_ENTRY_BY_NAME = 0xF009
    SYMBOL_UPLOAD = 0xF00B
    SYMBOL_UPLOAD_INFO = 0xF00C
    DATA_TYPE_UPLOAD = 0xF00E
    SYMBOL_UPLOAD_INFO_2 = 0xF00F
    SYMBOL_NOTIFICATION = 0xF010
    """Offset: handle of the symbol that a notification watches."""
    DATA_TYPE_BY_NAME = 0xF011
    SUM_READ = 0xF080
    SUM_WRITE = 0xF081
    SUM_READ_WRITE = 0xF082
    SUM_READ_EX = 0xF083
    SUM_READ_EX_2 = 0xF084
    SUM_ADD_NOTIFICATION = 0xF085
    SUM_DELETE_NOTIFICATION = 0xF086
    DEVICE_DATA = 0xF100
    """Offset 0: the ADS state, 2: the device state."""
    SDO = 0xF302
    """Offset: index in the high word, bit 8 complete access, bits 0 to 7 subindex."""
    OBJECT_LIST = 0xF3FC
    """Offset: type of the list in the high word."""
    OBJECT_DESCRIPTION = 0xF3FD
    ENTRY_DESCRIPTION = 0xF3FE
    """Offset: index in the high word, bits 8 to 15 value info, bits 0 to 7 subindex."""
    FOE_OPEN_READ = 0xF401
    """ReadWrite, offset: a password; a file name is written, a handle of four bytes read."""
    FOE_OPEN_WRITE = 0xF402
    """Likewise."""
    FOE_CLOSE = 0xF403
    """Of this and the next three the offset is a handle."""
    FOE_READ = 0xF404
    FOE_WRITE = 0xF405
    FOE_PROGRESS = 0xF406
    SOE = 0xF420
    """Offset: see :class:`SoeOffset`."""
    VOE = 0xF430
    """Written: a message with its VoE header."""
    EOE = 0xF440
    """Own format: a Write has an Ethernet frame for the slave.  The offset of a ReadWrite is the
    type of a message: 0 returns the frames that the slave has sent, each behind its length as 16
    bits, to the reader with the number of four bytes that is written; a request for settings has
    its body there, and returns the answer."""
    ROUTE_QUERY = 0x4541_5001
    """Own format: of the system service, where it forwards requests to, see ``HopQuestion``."""
    CONTROL = 0x4541_5002
    """Own format: ReadWrite of a request of the control protocol that only reads, see
    ``ControlOffset``."""
    CONFIGURE = 0x4541_5003
    """Own format: ReadWrite of a request of the control protocol that shows or changes the
    configuration of a station, see ``ConfigureOffset``."""


class ConfigureOffset(IntEnum):
    """Index offset in the group CONFIGURE: method of the control protocol."""

    EXPORT = 0
    PLAN = 1
    ROUTING_EXPORT = 2
    ROUTING_PLAN = 3
    APPLY = 4
    ROLLBACK = 5
    ROUTING_APPLY = 6
    ROUTING_ROLLBACK = 7

    @property
    def is_change(self) -> bool:
        """True if the method changes something; the others show or compare."""
        return self >= ConfigureOffset.APPLY


class AdsRange(WireStruct, frozen=True):
    """Request of Read, and the head of a Write before its data; *length* is in bytes."""

    group: u32
    offset: u32
    length: u32


class SdoOffset(WireStruct, frozen=True):
    """The offset that names an entry at SDO; ``encode`` gives its four bytes.

    *is_slow* allows a slave ten times as long, which Ads.h calls an extended time-out.
    """

    subindex: u8
    is_complete: bit = 0
    is_slow: bit = 0
    reserved: bits6 = 0
    index: u16 = 0


class SoeOffset(WireStruct, frozen=True):
    """The offset that names elements of an IDN at SOE.

    *is_command*: a procedure command is to be executed.
    """

    idn: u16
    elements: u8
    drive: bits3 = 0
    is_command: bit = 0
    reserved: bits4 = 0


class AdsReadWrite(WireStruct, frozen=True):
    """Head of a ReadWrite before the data that it writes; lengths are in bytes."""

    group: u32
    offset: u32
    read_length: u32
    write_length: u32


class AdsDeviceInfo(WireStruct, frozen=True):
    """Answer of ReadDeviceInfo behind its result; *name* is padded with zeros."""

    major: u8
    minor: u8
    build: u16
    name: octets16


class AdsStates(WireStruct, frozen=True):
    """Answer of ReadState behind its result; what *device_state* means is the device's affair."""

    ads_state: u16
    device_state: u16


class AdsWriteControl(WireStruct, frozen=True):
    """Head of a WriteControl before its data; *length* is in bytes."""

    ads_state: u16
    device_state: u16
    length: u32


class AdsSystemState(WireStruct, frozen=True):
    """Answer of the system service at SYSTEM_STATE, as the open client ads-client reads it."""

    ads_state: u16
    device_state: u16
    restart_index: u16 = 0
    version: u8 = 0
    revision: u8 = 0
    build: u16 = 0
    platform: u8 = 0
    os_type: u8 = 0
    flags: u16 = 0
    reserved: u16 = 0


def encode_result(result: int, data: bytes | None = None) -> bytes:
    """Return the body of an answer; with *data* that of a Read or ReadWrite."""
    octets = result.to_bytes(4, "little")
    return octets if data is None else octets + len(data).to_bytes(4, "little") + data


def device_name(text: str) -> bytes:
    """Return *text* cut to the 15 bytes of ReadDeviceInfo, with a NUL at the end."""
    return text.encode("latin-1", "replace")[:15].ljust(16, b"\0")
