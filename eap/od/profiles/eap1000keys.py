"""Names by which programs know the EAP profile's sub-indexes and what its entries show."""

from __future__ import annotations

from enum import IntEnum, StrEnum, auto


class Live(StrEnum):
    """What the running device is asked for; the object's name says of which one."""

    VALUE = auto()
    """Of the variable, as it lies in the process image."""
    FRAME_STATE = auto()
    FRAME_CTRL = auto()
    FRAME_WHOLE = auto()
    FRAME_PARTIAL = auto()
    FRAME_SKIPPED = auto()
    TX_VAR_STATE = auto()
    TX_VAR_CTRL = auto()
    TX_LAST_REASON = auto()
    TX_SKIPPED = auto()
    TX_SENT_CYCLE = auto()
    TX_SENT_DIVIDER = auto()
    TX_SENT_CHANGE = auto()
    TX_SENT_CHANGE_TIMEOUT = auto()
    TX_SENT_EVENT = auto()
    TX_SENT_POLL = auto()
    RX_QUALITY = auto()
    RX_CYCLE_INDEX = auto()
    RX_VAR_STATE = auto()
    RX_STATE = auto()
    RX_RECEIVED = auto()
    RX_LOST = auto()
    RX_DUPLICATED = auto()
    RX_REORDERED = auto()
    RX_LATE = auto()
    RX_TIMEOUTS = auto()
    RX_JITTER_MAX = auto()
    RX_DISCARDED_VERSION = auto()
    RX_DISCARDED_LENGTH = auto()
    RX_DISCARDED_SUPPRESSED = auto()
    RX_DISCARDED_STALE = auto()
    RX_DISCARDED_WRONG_SOURCE = auto()
    STATION_CYCLE = auto()
    STATION_OVERRUNS = auto()
    STATION_RESTARTS = auto()
    STATION_TORN = auto()
    STATION_LATENESS_MAX = auto()
    STATION_LINKS_HELD = auto()
    STATION_DISCARDED_WRONG_PUBLISHER = auto()
    STATION_DISCARDED_UNKNOWN_ID = auto()
    STATION_DISCARDED_TRUNCATED = auto()
    STATION_DISCARDED_COUNT_TOO_LARGE = auto()
    STATION_DISCARDED_WRONG_TYPE = auto()
    STATION_DISCARDED_TOO_MANY_REQUESTS = auto()
    STATION_DISCARDED_NO_SENDER = auto()


class Derived(StrEnum):
    """What the dictionary computes from other entries."""

    BIT_LENGTH = auto()
    TYPE_CODE = auto()
    PDO_LENGTH = auto()
    FRAME_LENGTH = auto()
    COUNT = auto()
    """Objects of the kind that the sub-index stands for, see COUNTED."""
    NEXT_FREE = auto()
    """First free index of that kind, 0 if all are taken."""


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


class Frame(IntEnum):
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
    TXPD = 16


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


class Port(IntEnum):
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


class AddressMode(IntEnum):
    """How a TxFrame names its destination."""

    MAC = 0
    NETID = 1
    IP = 2
    TCP = 3
    REQUESTER = 4


class RxFlag(IntEnum):
    """Bits of an RxPD's flags."""

    IGNORE_NETID = 0x01
    IGNORE_VERSION = 0x04
    ENABLED = 0x80


class WrittenBy(IntEnum):
    """Who writes a Tx variable."""

    APPLICATION = 0
    ENGINE = 1
    SERVICES = 2


class Substituted(IntEnum):
    """What the variables of an RxPD hold after its time-out."""

    HOLD = 0
    ZERO = 1
    DEFAULT = 2


class Waking(IntEnum):
    """When a port takes frames."""

    CYCLE = 0
    ARRIVAL = 1
