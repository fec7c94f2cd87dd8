"""The AoE router: modular device profile 5001, sub-profile 9000 (ETG.5001, ETG.1005).

Public descriptions say that 0x8000 on are the AoE devices of a station, with interfaces and NetIDs,
and that 0xF000 on is about the router itself.  The sub-indexes, and the routes from 0x9000 on, are
ours (own format): no public document has them.
"""

from __future__ import annotations

from enum import StrEnum, auto

from eap.od.model import ObjectCode
from eap.od.profiles.eap1000 import MAX_ENTRIES, NAME, TEXT, identity
from eap.od.profiles.table import Form, ProfileObject, fixed, live, single

MODULE_PROFILE = 9000
ROUTER = "router"
"""Name of the router of a station, beside its ports; a port of that name goes before."""
MASTER_PROFILE = 1100
"""Sub-profile of a bus port."""

_RECORD, _ARRAY = ObjectCode.RECORD, ObjectCode.ARRAY


class RouterLive(StrEnum):
    """Keys of live entries of the router."""

    DEVICE_STATE = auto()
    DEVICE_MAC = auto()
    STATE = auto()
    ANSWERED = auto()
    FAILED = auto()
    DENIED = auto()
    LOOPS = auto()
    LATE = auto()
    DROPPED = auto()
    WAITING = auto()
    ROUTES = auto()
    CONNECTIONS = auto()
    SUBSCRIPTIONS = auto()
    ROUTE_NET_ID = auto()
    ROUTE_OCTETS = auto()
    ROUTE_NAME = auto()
    ROUTE_TRANSPORT = auto()
    ROUTE_ADDRESS = auto()
    ROUTE_ORIGIN = auto()
    ROUTE_STATE = auto()
    ROUTE_ROUND_TRIP = auto()
    ROUTE_REQUESTS = auto()
    ROUTE_ERRORS = auto()
    ROUTE_LAST_ERROR = auto()


DEVICE = ProfileObject(
    0x8000, 0x8FFF, "AoE device {n}", _RECORD,
    (
        fixed(1, "NetID", "BLOCK(6)", "Of the port.", form=Form.NET_ID),
        fixed(2, "Sub-profile", "UINT", "1000 an EAP port, 1100 a bus port."),
        fixed(3, "Interface", TEXT, "Such as udp://10.0.0.1 or ethernet://eth0."),
        live(4, "MAC address", "BLOCK(6)", RouterLive.DEVICE_MAC,
             "Of the Ethernet interface; all zero "
             "where the port is not bound to one.", form=Form.MAC),
        fixed(5, "IP address", "BLOCK(4)", "First byte first; all zero where there is none.",
              form=Form.IP),
        live(6, "State", "UINT", RouterLive.DEVICE_STATE,
             "1 Init, 2 PreOp, 4 SafeOp, 8 Op; of a bus "
             "that of the slave that is least far; 0 unknown."),
        fixed(7, "Name", NAME, "Of the port, in the plant file."),
    ),
    "A port of the station, in the order of the plant file.",
)  # fmt: skip
ROUTE = ProfileObject(
    0x9000, 0x93FF, "Route {n}", _RECORD,
    (
        live(1, "NetID", "BLOCK(6)", RouterLive.ROUTE_NET_ID,
             "Stations with it, or with one that begins alike, "
             "are reached by this route.", form=Form.NET_ID),
        live(2, "Octets", "USINT", RouterLive.ROUTE_OCTETS,
             "How many bytes of it have to match: 6, 5 "
             "or 4; 0 a default route."),
        live(3, "Name", NAME, RouterLive.ROUTE_NAME, "For operators."),
        live(4, "Transport", NAME, RouterLive.ROUTE_TRANSPORT, "By which packets leave."),
        live(5, "Address", NAME, RouterLive.ROUTE_ADDRESS, "Where they go from there."),
        live(6, "Origin", "USINT", RouterLive.ROUTE_ORIGIN,
             "0 the plant file, 1 added at run time, 2 "
             "learned."),
        live(7, "State", "USINT", RouterLive.ROUTE_STATE, "0 unknown, 1 up, 2 down, 3 client."),
        live(8, "Round trip", "UDINT", RouterLive.ROUTE_ROUND_TRIP,
             "To the next hop and back, at the "
             "last time; 0 unknown.", unit="us"),
        live(9, "Requests", "ULINT", RouterLive.ROUTE_REQUESTS, "That went there."),
        live(10, "Errors", "ULINT", RouterLive.ROUTE_ERRORS, "Of those, that did not get there."),
        live(11, "Last error", TEXT, RouterLive.ROUTE_LAST_ERROR, "In words."),
    ),
    "A route, of the first 1024 in the order of the table: objects come and go with the routes.",
)  # fmt: skip
MODULES = single(
    0xF010, "Module list", "Which kind of device each AoE device is.",
    fixed(1, "Module {n}", "UDINT", "Sub-profile of the AoE device of that number.",
          last=MAX_ENTRIES),
)  # fmt: skip
DIAGNOSIS = single(
    0xF110, "Router diagnosis", "Packets by what became of them, and what there is now.",
    live(1, "Answered", "ULINT", RouterLive.ANSWERED,
         "Requests that were answered by their target."),
    live(2, "Failed", "ULINT", RouterLive.FAILED,
         "Requests that the router answered with an error."),
    live(3, "Denied", "ULINT", RouterLive.DENIED,
         "Requests that access rules refused, in part or all."),
    live(4, "Loops", "ULINT", RouterLive.LOOPS, "Packets that ran in a circle."),
    live(5, "Late", "ULINT", RouterLive.LATE, "Answers after their requests had timed out."),
    live(6, "Dropped", "ULINT", RouterLive.DROPPED, "Packets that were left without an answer."),
    live(7, "Waiting", "UDINT", RouterLive.WAITING, "Requests that wait for their answers."),
    live(8, "Routes", "UDINT", RouterLive.ROUTES, "That there are."),
    live(9, "Connections", "UDINT", RouterLive.CONNECTIONS, "Clients by connection or address."),
    live(10, "Notifications", "UDINT", RouterLive.SUBSCRIPTIONS,
         "Forwarded to clients."),
)  # fmt: skip
STATIC = (
    *identity(MODULE_PROFILE),
    single(0xF000, "Modular device profile", "How the objects are numbered.",
           fixed(1, "Index distance", "UINT", "Between two objects of a range.", default=1),
           fixed(2, "Maximum number", "UINT", "Of AoE devices.", default=MAX_ENTRIES)),
    MODULES,
    single(0xF100, "Router status", "Where the station stands.",
           live(1, "State", "UINT", RouterLive.STATE, "1 Init, 2 PreOp, 4 SafeOp, 8 Op.")),
    DIAGNOSIS,
    single(0xF920, "AoE NetID", "Of the router.",
           fixed(1, "NetID", "BLOCK(6)", "By which all of the station is reached.",
                 form=Form.NET_ID)),
)  # fmt: skip
ALL = tuple(sorted((*STATIC, DEVICE, ROUTE), key=lambda row: row.first))
