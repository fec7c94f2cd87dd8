"""Access rules: the operations that a client may have done or forwarded.

Rules come from the plant file; the first one that fits says yes or no.  Where none fits, a program
on this host may do everything and other hosts only read.  What an operation is does not depend on
its command alone: a ReadWrite that looks a name up reads, a file opened for write is written.

A rule about objects grants what lies in its ranges as a whole, and refuses what touches them.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from ipaddress import IPv4Address, IPv4Network
from typing import NamedTuple

from eap.ads.request import SUM_COMMANDS, Operation, Read, ReadWrite, Write, WriteControl
from eap.ams.spec import IP_TRANSPORTS, AccessRule, AccessService, ObjectRange, TransportKind
from eap.codec.ads import IndexGroup
from eap.codec.adsnotification import AddNotification
from eap.ids import Endpoint, MacAddr, NetId

_MAX_KNOWN = 4096
"""Cached pairs of a client and a target."""

_RAW = frozenset((IndexGroup.RAW_COMMAND, IndexGroup.VOE, *SUM_COMMANDS))
"""Sum commands: one inside another, which is not parsed."""
_FILES = frozenset((IndexGroup.FOE_OPEN_WRITE, IndexGroup.FOE_WRITE))
_STATES = frozenset((IndexGroup.MASTER_STATE, IndexGroup.SLAVE_STATES))
_OWN_HANDLES = frozenset((IndexGroup.RELEASE_HANDLE, IndexGroup.FOE_CLOSE))
LOOKUPS = frozenset(
    (
        IndexGroup.SYMBOL_HANDLE,
        IndexGroup.VALUE_BY_NAME,
        IndexGroup.SYMBOL_BY_NAME,
        IndexGroup.SYMBOL_ENTRY_BY_NAME,
        IndexGroup.DATA_TYPE_BY_NAME,
        IndexGroup.FOE_OPEN_READ,
        IndexGroup.FOE_CLOSE,
        IndexGroup.FOE_READ,
        IndexGroup.FOE_PROGRESS,
        IndexGroup.ROUTE_QUERY,
    )
)
"""Groups whose ReadWrite changes only the client's own handles."""


_ADDRESSED = (Read, Write, ReadWrite, AddNotification)
"""Operations with group and offset.  A tuple: a union would be built at each call."""


def service_of(operation: Operation) -> AccessService:
    """Return the kind of access that an operation needs."""
    if isinstance(operation, WriteControl):
        return AccessService.CONTROL
    if not isinstance(operation, (Write, ReadWrite)):
        return AccessService.READ
    group = operation.group
    if group in _RAW:
        return AccessService.RAW
    if group in _FILES:
        return AccessService.FILES
    if group in (LOOKUPS if isinstance(operation, ReadWrite) else _OWN_HANDLES):
        return AccessService.READ
    return AccessService.CONTROL if group in _STATES else AccessService.WRITE


def group_and_offset(operation: Operation) -> tuple[int | None, int]:
    """Return index group and offset; the group is None if the operation has none."""
    if isinstance(operation, _ADDRESSED):
        return operation.group, operation.offset
    return None, 0


def objects_of(operation: Operation) -> ObjectRange | None:
    """Return which entries of a dictionary an operation is about, None if it is about none."""
    group, offset = group_and_offset(operation)
    if group not in _OF_OBJECTS:
        return None
    index, subindex = offset >> 16, offset & 0xFF
    if group == IndexGroup.OBJECT_DESCRIPTION or (group == IndexGroup.SDO and offset & _WHOLE):
        return ObjectRange(index, index)
    return ObjectRange(index, index, subindex, subindex)


_WHOLE = 0xFD00
"""Bits of an offset with which it is not about one entry: complete access, and unknown ones."""
_OF_OBJECTS = frozenset(
    (IndexGroup.SDO, IndexGroup.OBJECT_DESCRIPTION, IndexGroup.ENTRY_DESCRIPTION)
)


class Decision(NamedTuple):
    """Decision on one operation."""

    service: AccessService
    is_allowed: bool
    why: str
    """The rule, in words."""
    is_by_rule: bool = False
    """True if a rule of the plant file decides, False for the default."""
    is_recordable: bool = True
    """True if the audit can record it, where that is required."""


class Grants:
    """Rights of one client at one target."""

    def __init__(self, rules: Sequence[AccessRule], *, is_this_host: bool) -> None:
        self._by_service = {
            service: tuple(rule for rule in rules if not rule.services or service in rule.services)
            for service in AccessService
        }
        self._is_this_host = is_this_host
        self.may_read = self.may(AccessService.READ) is True

    def decide(self, operation: Operation) -> Decision:
        """Decide on one operation."""
        service = service_of(operation)
        accessed = objects_of(operation)
        # The first rule that fits decides, as in the plant file.
        for rule in self._by_service[service]:
            if not rule.objects or (accessed is not None and _is_about(rule, accessed)):
                verb = "allows" if rule.allow else "refuses"
                return Decision(service, rule.allow, f"rule {rule.name} {verb} it", is_by_rule=True)
        if self._is_this_host:
            return Decision(service, True, "no rule refuses it to this host")
        if service is AccessService.READ:
            return Decision(service, True, "no rule refuses reading")
        return Decision(service, False, "no rule allows it, and other hosts only read")

    def may(self, service: AccessService) -> bool | None:
        """Return whether *service* is allowed; None if that depends on the object."""
        rules = self._by_service[service]
        whole = next((rule for rule in rules if not rule.objects), None)
        if whole is None:
            otherwise = self._is_this_host or service is AccessService.READ
        else:
            otherwise = whole.allow
            rules = rules[: rules.index(whole)]
        return otherwise if all(rule.allow is otherwise for rule in rules) else None


class AccessList:
    """The rules of a station.

    Args:
        rules: The first that fits counts.
        own: Addresses of this station: a connection from one of them is from this host.
    """

    def __init__(
        self, rules: Sequence[AccessRule] = (), *, own: Collection[IPv4Address] = ()
    ) -> None:
        self._rules = [_Matcher(rule) for rule in rules]
        self._own = frozenset(own)
        self._known: dict[tuple[Endpoint, NetId, NetId, int], Grants] = {}

    def grants(self, endpoint: Endpoint, source: NetId, target: NetId, port: int) -> Grants:
        """Return the rights of the client at *endpoint* that uses the NetID *source*."""
        key = endpoint, source, target, port
        grants = self._known.get(key)
        if grants is None:
            # Source NetIDs can be invented: the cache must not grow with them.
            if len(self._known) >= _MAX_KNOWN:
                self._known.clear()
            grants = self._known[key] = self._find(endpoint, source, target, port)
        return grants

    def is_this_host(self, endpoint: Endpoint) -> bool:
        """Return whether *endpoint* can only be a program of this host."""
        kind = endpoint.kind
        if kind not in IP_TRANSPORTS:
            return kind == TransportKind.LOCAL
        address = address_of(endpoint)
        return address is not None and (address.is_loopback or address in self._own)

    def _find(self, endpoint: Endpoint, source: NetId, target: NetId, port: int) -> Grants:
        address = address_of(endpoint)
        rules = [
            each.rule
            for each in self._rules
            if each.is_from(endpoint, address, source) and each.is_to(target, port)
        ]
        return Grants(rules, is_this_host=self.is_this_host(endpoint))


def address_of(endpoint: Endpoint) -> IPv4Address | None:
    """Return the IPv4 address of an endpoint, None if it has none."""
    if endpoint.kind not in IP_TRANSPORTS:
        return None
    try:
        return IPv4Address(endpoint.connection.partition(":")[0])
    except ValueError:
        return None


def host_of(endpoint: Endpoint) -> str:
    """Return the host of *endpoint*, the same for all its connections."""
    kind = endpoint.kind
    if kind in IP_TRANSPORTS:
        return endpoint.connection.partition(":")[0]
    return "" if kind == TransportKind.LOCAL else endpoint.connection


class _Matcher:
    """Access rule with its addresses parsed."""

    def __init__(self, rule: AccessRule) -> None:
        self.rule = rule
        self._networks = tuple(map(IPv4Network, rule.networks))
        self._macs = frozenset(str(MacAddr.parse(text)) for text in rule.macs)
        self._net_ids = tuple(map(_prefix, rule.net_ids))
        self._targets = tuple((_prefix(each.net_id), each.port) for each in rule.targets)

    def is_from(self, endpoint: Endpoint, address: IPv4Address | None, source: NetId) -> bool:
        transports = self.rule.transports
        if transports and endpoint.transport not in transports and endpoint.kind not in transports:
            return False
        if self._net_ids and not source.startswith(self._net_ids):
            return False
        if not (self._networks or self._macs):
            return True
        # Ethernet has no IP address: the MAC address alone identifies the peer.
        if endpoint.kind == TransportKind.ETHERNET:
            return endpoint.connection in self._macs
        return address is not None and any(address in each for each in self._networks)

    def is_to(self, target: NetId, port: int) -> bool:
        return not self._targets or any(
            target.startswith(prefix) and wanted in {None, port} for prefix, wanted in self._targets
        )


def _prefix(text: str) -> bytes:
    return bytes(map(int, text.split(".")))


def _is_about(rule: AccessRule, accessed: ObjectRange) -> bool:
    """Return whether a rule grants all of *accessed*, or refuses any of it."""
    if rule.allow:
        return any(each.contains(accessed) for each in rule.objects)
    return any(each.overlaps(accessed) for each in rule.objects)
