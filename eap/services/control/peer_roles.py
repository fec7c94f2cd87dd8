"""Roles of the clients of the control socket, by the users of the operating system.

Processes of the appliance's own user and of root may do everything: their files are open to them
anyway.  Other users have the role that the plant file gives them, and none without an entry there.
"""

from __future__ import annotations

import grp
import os
import pwd
import socket
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from eap.ads.request import AdsRefusedError, parse_request
from eap.ams.access import service_of
from eap.ams.spec import AccessService, Role
from eap.config.selection import match_names
from eap.config.users import PlantUserSection
from eap.control.protocol import Request
from eap.runtime.logins import Principal
from eap.services.transports.accepting import process_of

_ROOT = 0
_FOR_VIEWERS = frozenset(
    (
        *("hello", "status", "pd_list", "variables", "read", "subscribe", "unsubscribe", "state"),
        *("od_list", "od_describe", "od_read", "od_dump", "export", "plan", "routing_export"),
        *("routing_plan", "gateway_status", "routes_list", "routes_test", "routes_export", "trace"),
        *("log_levels", "field_points", "bus_describe", "bus_open", "bus_close"),
    )
)
"""Methods that change nothing."""
_BY_PARAMETERS = frozenset(("bus_ask", "bus_transfer"))
"""Methods that read or change; so does ams_ask, of which the audit has the ADS request."""


class ControlPeer(NamedTuple):
    """Client of the control socket.

    Attributes:
        text: User and process, for the audit.
        user: User of the plant file, with a role; its name is empty for the appliance's own user.
    """

    text: str
    user: Principal

    @property
    def is_own(self) -> bool:
        """True for root and the appliance's user, whose programs may act for other users."""
        return not self.user.name


class PeerRoles:
    """Roles of clients.

    Args:
        users: Users of the plant; without any, each client may do everything.
        operators: Patterns of the variables that operators set.
    """

    def __init__(
        self, users: Sequence[PlantUserSection] = (), operators: Iterable[str] = ()
    ) -> None:
        self._users = users
        self._operators = tuple(operators)

    def own_peer(self, connection: socket.socket) -> ControlPeer | None:
        """Return a client that may do everything, None if the user database has to be asked."""
        pid, uid = process_of(connection)
        if self._users and uid not in {_ROOT, os.geteuid()}:
            return None
        return ControlPeer(_text_of(pid, uid), Principal("", Role.ENGINEER))

    def identify(self, connection: socket.socket) -> ControlPeer | None:
        """Return another client, by the user database; None for one without a role."""
        pid, uid = process_of(connection)
        try:
            account = pwd.getpwuid(uid)
        except KeyError:
            return None
        groups = {_group_name(gid) for gid in os.getgrouplist(account.pw_name, account.pw_gid)}
        for user in self._users:
            if account.pw_name in user.unix or not groups.isdisjoint(user.groups):
                return ControlPeer(_text_of(pid, uid), Principal(user.name, user.role))
        return None

    def reason_denied(
        self, peer: ControlPeer, request: Request, *, is_change: Callable[[], bool]
    ) -> str:
        """Return why a client may not make a request, empty if it may.

        *is_change* says whether one that depends on its parameters changes something.
        """
        if peer.is_own:
            return ""
        if request.params.get("origin") is not None:
            return "only programs of the appliance's user act for other users"
        needed = _needed_role(request, is_change)
        if not peer.user.may_act_as(needed):
            return f"{peer.user.name} is {peer.user.role}, and {request.method} needs {needed}"
        if request.method == "write" and peer.user.role is Role.OPERATOR:
            return self._reason_not_set(request.params)
        return ""

    def _reason_not_set(self, params: dict[str, Any]) -> str:
        values = params.get("values")
        for name in values if isinstance(values, dict) else ():
            full = f"{params.get('station')}/{name}"
            if not any(match_names(pattern, [full]) for pattern in self._operators):
                return f"{full} is set by engineers only: access.operators does not name it"
        return ""


def _text_of(pid: int, uid: int) -> str:
    return f"uid {uid}, pid {pid}"


def _needed_role(request: Request, is_change: Callable[[], bool]) -> Role:
    if request.method == "write":
        return Role.OPERATOR
    if request.method in _FOR_VIEWERS:
        return Role.VIEWER
    is_read = request.method in _BY_PARAMETERS and not is_change()
    return Role.VIEWER if is_read or _is_ads_read(request) else Role.ENGINEER


def _is_ads_read(request: Request) -> bool:
    if request.method != "ams_ask":
        return False
    try:
        data = bytes.fromhex(request.params.get("data", ""))
        operations = parse_request(request.params["command"], data).operations
    except (AdsRefusedError, KeyError, TypeError, ValueError):
        return False
    return all(service_of(each) is AccessService.READ for each in operations)


def _group_name(gid: int) -> str:
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return ""
