"""Access rules: the operations that a client may have done or forwarded.

Rules come from the plant file; the first one that fits says yes or no.  Where none fits, a program
on this host may do everything and other hosts only read.  What an operation is does not depend on
its command alone: a ReadWrite that looks a name up reads, a file opened for write is written.

A rule about objects grants what lies in its ranges as a whole, and refuses what touches them.

:class:`AccessFilter` applies the rules to the requests of a router, item by item in a sum command.
It also collects the audit entries: changes that were made, and requests that were refused.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from ipaddress import IPv4Address, IPv4Network
from typing import NamedTuple

from eap.ads.request import (
    SUM_COMMANDS,
    AdsRefusedError,
    AdsRequest,
    Operation,
    OperationOutcome,
    Read,
    ReadWrite,
    Write,
    WriteControl,
    encode_refusal,
    encode_sum,
    has_results,
    parse_request,
    part_of,
    split_answer,
)
from eap.ams.error_reply import RoutingError
from eap.ams.record import Outcome, Record, Trace, describe
from eap.ams.spec import (
    IP_TRANSPORTS,
    NAMED_CLIENTS,
    AccessRule,
    AccessService,
    ObjectRange,
    Role,
    TransportKind,
)
from eap.codec.ads import AdsError, ConfigureOffset, IndexGroup
from eap.codec.adsnotification import AddNotification
from eap.codec.ams import AmsCommand, AmsHeader
from eap.codec.eoe import READS as EOE_READS
from eap.ids import Endpoint, MacAddr, NetId

_MAX_KNOWN = 4096
"""Cached pairs of a client and a target."""

_RAW = frozenset((IndexGroup.RAW_COMMAND, IndexGroup.VOE, IndexGroup.EOE, *SUM_COMMANDS))
"""Sum commands: one inside another, which is not parsed."""
_OF_GROUP: dict[int, AccessService] = {
    IndexGroup.FOE_OPEN_WRITE: AccessService.FILES,
    IndexGroup.FOE_WRITE: AccessService.FILES,
    IndexGroup.CONFIGURE: AccessService.CONFIGURE,
}
"""Services of groups that have one of their own."""
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
        IndexGroup.CONTROL,
    )
)
"""Groups whose ReadWrite changes only the client's own handles."""

_CONFIGURE_READS = frozenset(each for each in ConfigureOffset if not each.is_change)

# A tuple: a union would be built at each call.
_ADDRESSED = (Read, Write, ReadWrite, AddNotification)
"""Operations with group and offset."""


def service_of(operation: Operation) -> AccessService:
    """Return the kind of access that an operation needs."""
    if isinstance(operation, WriteControl):
        return AccessService.CONTROL
    if not isinstance(operation, (Write, ReadWrite)):
        return AccessService.READ
    group = operation.group
    is_exchange = isinstance(operation, ReadWrite)
    if group in _RAW:
        is_read = group == IndexGroup.EOE and is_exchange and operation.offset in EOE_READS
        return AccessService.READ if is_read else AccessService.RAW
    if group in _OF_GROUP:
        return _OF_GROUP[group]
    if group in (LOOKUPS if is_exchange else _OWN_HANDLES):
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
        # Rules behind the first one for all objects never decide.
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
        self._known: dict[tuple[Endpoint, NetId, NetId, int, Role | None], Grants] = {}

    def grants(
        self, endpoint: Endpoint, source: NetId, target: NetId, port: int, role: Role | None = None
    ) -> Grants:
        """Return the rights of the client at *endpoint* that uses the NetID *source*.

        *role* is that of a user who has logged in; rules take other clients by their addresses.
        """
        key = endpoint, source, target, port, role
        grants = self._known.get(key)
        if grants is None:
            # Source NetIDs can be invented: the cache must not grow with them.
            if len(self._known) >= _MAX_KNOWN:
                self._known.clear()
            grants = self._known[key] = self._find(endpoint, source, target, port, role)
        return grants

    def is_this_host(self, endpoint: Endpoint) -> bool:
        """Return whether *endpoint* can only be a program of this host."""
        kind = endpoint.kind
        if kind not in IP_TRANSPORTS:
            return kind == TransportKind.LOCAL
        address = address_of(endpoint)
        return address is not None and (address.is_loopback or address in self._own)

    def _find(
        self, endpoint: Endpoint, source: NetId, target: NetId, port: int, role: Role | None
    ) -> Grants:
        address = address_of(endpoint)
        rules = [
            each.rule
            for each in self._rules
            if each.is_from(endpoint, address, source, role) and each.is_to(target, port)
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


class _Senders:
    """IPv4 networks, MAC addresses and transports of clients."""

    def __init__(self, texts: Iterable[str]) -> None:
        transports, networks, macs = set(), [], set()
        for text in texts:
            if text.startswith(NAMED_CLIENTS):
                transports.add(text)
            elif ":" in text or "-" in text:
                macs.add(str(MacAddr.parse(text)))
            else:
                networks.append(IPv4Network(text))
        self._transports = frozenset(transports)
        self._networks, self._macs = tuple(networks), frozenset(macs)
        self.is_empty = not (transports or networks or macs)

    def has(self, endpoint: Endpoint, address: IPv4Address | None) -> bool:
        if endpoint.transport in self._transports:
            return True
        # Ethernet has no IP address: the MAC address alone identifies the peer.
        if endpoint.kind == TransportKind.ETHERNET:
            return endpoint.connection in self._macs
        return address is not None and any(address in each for each in self._networks)


class _Matcher:
    """Access rule with its addresses parsed."""

    def __init__(self, rule: AccessRule) -> None:
        self.rule = rule
        self._senders = _Senders(rule.networks + rule.macs)
        self._members = _Senders(rule.members)
        self._net_ids = tuple(map(_prefix, rule.net_ids))
        self._targets = tuple((_prefix(each.net_id), each.port) for each in rule.targets)

    def is_from(
        self, endpoint: Endpoint, address: IPv4Address | None, source: NetId, role: Role | None
    ) -> bool:
        transports = self.rule.transports
        if transports and endpoint.transport not in transports and endpoint.kind not in transports:
            return False
        if self._net_ids and not source.startswith(self._net_ids):
            return False
        if self.rule.roles and not (
            role in self.rule.roles if role else self._members.has(endpoint, address)
        ):
            return False
        return self._senders.is_empty or self._senders.has(endpoint, address)

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


_DENIED = OperationOutcome(AdsError.ACCESS_DENIED)
_RESULT = 4


class AddRoute(NamedTuple):
    """Request for a route by UDP 48899; *user* is the name in it, which proves nothing."""

    name: str
    net_id: str
    address: str
    user: str


class AuditedOperation(NamedTuple):
    """One operation, what was decided on it, and how it came out."""

    operation: Operation | AddRoute
    decision: Decision
    result: int | None
    """None if unknown: there was no answer, or it cannot be parsed."""

    @property
    def is_audited(self) -> bool:
        """True if the audit has it: it changed something, or was refused."""
        if not self.decision.is_allowed:
            return True
        if self.decision.service is AccessService.READ or _is_look_at_configuration(self.operation):
            return False
        # Of a file only the opening is audited: a megabyte is a thousand writes.
        is_piece = getattr(self.operation, "group", None) == IndexGroup.FOE_WRITE
        return not is_piece or bool(self.result)


def _is_look_at_configuration(operation: Operation | AddRoute) -> bool:
    group = getattr(operation, "group", None)
    return group == IndexGroup.CONFIGURE and getattr(operation, "offset", 0) in _CONFIGURE_READS


class AuditEntry(NamedTuple):
    """Audit entry: a request with changes, made or refused."""

    endpoint: Endpoint
    header: AmsHeader
    """Of the request, as it came."""
    route: str
    """Name of the route that it was forwarded by; empty for a service of this station."""
    operations: tuple[AuditedOperation, ...]


class AuthorizedRequest(NamedTuple):
    """A request and what was decided on its operations."""

    endpoint: Endpoint
    header: AmsHeader
    route: str
    """As in the audit."""
    request: AdsRequest
    decisions: tuple[Decision, ...]

    @property
    def denied(self) -> list[Decision]:
        """The verdicts on what may not be done."""
        return [each for each in self.decisions if not each.is_allowed]

    @property
    def changes(self) -> AuditEntry:
        """Entry of the changes in the request that are allowed; none of them is done yet."""
        entry = self._entry([None] * len(self.decisions))
        allowed = tuple(each for each in entry.operations if each.decision.is_allowed)
        return entry._replace(operations=allowed)

    def deny_changes(self, why: str) -> AuthorizedRequest:
        """Return the request with all that changes something refused."""
        return self._replace(
            decisions=tuple(
                each
                if each.service is AccessService.READ or not each.is_allowed
                else each._replace(is_allowed=False, why=why)
                for each in self.decisions
            )
        )

    def encode_part(self) -> bytes:
        """Return the body of a sum command with what may be done."""
        return encode_sum(self._part())

    def complete(self, error_code: int, body: bytes) -> tuple[bytes, AuditEntry]:
        """Return the answer to the whole of the request, and what the audit says of it.

        Args:
            error_code: Of the AMS header of the answer.
            body: Of the answer to the forwarded part.
        """
        part = self._part()
        results: list[int | None] = [error_code or _first_result(body)] * len(part.operations)
        outcomes = split_answer(part, body) if part.sum_group and not error_code else None
        if outcomes is not None:
            results = [each.result for each in outcomes]
            if self.denied:
                left = iter(outcomes)
                body = self.request.encode_answer(
                    [next(left) if each.is_allowed else _DENIED for each in self.decisions]
                )
        return body, self._entry(results)

    def abandon(self, error_code: int | None) -> AuditEntry:
        """Return the audit entry of a request without an answer.

        Args:
            error_code: That its client got; None if it got nothing.
        """
        return self._entry([error_code] * len(self.decisions))

    def _part(self) -> AdsRequest:
        if not self.denied:
            return self.request
        pairs = zip(self.request.operations, self.decisions, strict=True)
        return part_of(self.request, [each for each, decision in pairs if decision.is_allowed])

    def _entry(self, results: Sequence[int | None]) -> AuditEntry:
        """Return an entry; *results* are those of what was allowed."""
        left = iter(results)
        operations = (
            AuditedOperation(
                operation, decision, next(left) if decision.is_allowed else _DENIED.result
            )
            for operation, decision in zip(self.request.operations, self.decisions, strict=True)
        )
        audited = tuple(each for each in operations if each.is_audited)
        return AuditEntry(self.endpoint, self.header, self.route, audited)


def _first_result(body: bytes) -> int | None:
    return int.from_bytes(body[:_RESULT], "little") if len(body) >= _RESULT else None


MAX_ENTRIES = 4096
"""Audit entries that wait to be written; the oldest one is dropped for a new one."""
_NOTIFICATION = AmsCommand.NOTIFICATION.value  # plain numbers: members of enums are slow
_READ_WRITE = AmsCommand.READ_WRITE.value
_READS = frozenset(
    (
        AmsCommand.READ_DEVICE_INFO,
        AmsCommand.READ,
        AmsCommand.READ_STATE,
        AmsCommand.ADD_NOTIFICATION,
        AmsCommand.DELETE_NOTIFICATION,
    )
)
_READ_GROUPS = frozenset(
    group.to_bytes(4, "little")
    for group in (
        *LOOKUPS,
        IndexGroup.SUM_READ,
        IndexGroup.SUM_READ_EX,
        IndexGroup.SUM_READ_EX_2,
        IndexGroup.SUM_ADD_NOTIFICATION,
        IndexGroup.SUM_DELETE_NOTIFICATION,
    )
)
"""Groups of a ReadWrite that only reads, whatever else it holds."""
_GROUP = slice(AmsHeader.SIZE, AmsHeader.SIZE + 4)
_LENGTH = 20
"""Offset of the length of the body in the header."""


class AccessFilter:
    """Applies the access rules to requests.

    Args:
        access: The rules.
        record: Where refusals of items are remembered; the router itself does it for whole ones.

    Attributes:
        access: The rules, which may become others.
        before_change: Called with each change before it goes in or on, where changes that cannot
            be recorded are refused: returns why it cannot be, empty if it was.
    """

    def __init__(self, access: AccessList, record: Record) -> None:
        self.access = access
        self.before_change: Callable[[AuditEntry], str] | None = None
        self._record = record
        self._entries: deque[AuditEntry] = deque(maxlen=MAX_ENTRIES)

    @property
    def has_entries(self) -> bool:
        """True if :meth:`next_entry` has one."""
        return bool(self._entries)

    def next_entry(self) -> AuditEntry | None:
        """Take the oldest entry of the audit."""
        return self._entries.popleft() if self._entries else None

    def may(self, header: AmsHeader, endpoint: Endpoint) -> dict[AccessService, bool | None]:
        """Return the rights of a client at its target; None if they depend on the object."""
        grants = self.access.grants(endpoint, header.source, header.target, header.target_port)
        return {service: grants.may(service) for service in AccessService}

    def filter_request(
        self, header: AmsHeader, data: bytes, endpoint: Endpoint, now_ns: int, route: str = ""
    ) -> tuple[bytes, AuthorizedRequest | None] | RoutingError:
        """Return a request as it is delivered or forwarded, and its authorization, or an error.

        Args:
            header: As it came.
            data: All of the packet.
            endpoint: Of the client.
            now_ns: The time on the monotonic clock.
            route: Name of the route that it would be forwarded by.
        """
        if header.command == _NOTIFICATION:
            return data, None  # samples reach only clients that subscribed
        grants = self.access.grants(endpoint, header.source, header.target, header.target_port)
        # Most requests only read: they pass by command or group, without parsing their operations.
        if grants.may_read and (
            header.command in _READS
            or (header.command == _READ_WRITE and data[_GROUP] in _READ_GROUPS)
        ):
            return data, None
        try:
            request = parse_request(header.command, data[AmsHeader.SIZE :])
        except AdsRefusedError as exc:
            is_recorded = self.before_change is not None
            # What cannot be read cannot be audited either: with a required audit it is refused.
            is_allowed_unread = grants.may(AccessService.RAW) and not is_recorded
            return (data, None) if is_allowed_unread else _refuse_unreadable(header, exc)
        decisions = tuple(map(grants.decide, request.operations))
        authorized = AuthorizedRequest(endpoint, header, route, request, decisions)
        if why := self._record_changes(authorized):
            authorized = authorized.deny_changes(why)
        if authorized.denied:
            return self._refuse(authorized, now_ns) or (
                exchange_body(data, authorized.encode_part()),
                authorized,
            )
        is_read = all(each.service is AccessService.READ for each in decisions)
        return data, None if is_read else authorized

    def complete(self, authorized: AuthorizedRequest, error_code: int, body: bytes) -> bytes:
        """Return the body of the answer to the whole request, denied items included."""
        body, entry = authorized.complete(error_code, body)
        self._enter(entry)
        return body

    def abandon(self, authorized: AuthorizedRequest, error_code: int | None = None) -> None:
        """Audit a request without an answer; *error_code* is the reply to the client, if any."""
        self._enter(authorized.abandon(error_code))

    def _record_changes(self, authorized: AuthorizedRequest) -> str:
        """Record what a request is going to change, where that is required; return why not."""
        if self.before_change is None:
            return ""
        changes = authorized.changes
        return self.before_change(changes) if changes.operations else ""

    def _refuse(self, authorized: AuthorizedRequest, now_ns: int) -> RoutingError | None:
        """Refuse a request as a whole, unless some of its items may be done."""
        request, text = authorized.request, _describe(authorized)
        count = len(authorized.decisions)
        # A sum with a result for each item is forwarded without the denied items.
        if has_results(request) and len(authorized.denied) < count:
            header, endpoint, code = authorized.header, authorized.endpoint, AdsError.ACCESS_DENIED
            text = f"{describe(header, endpoint)}: {text}"
            self._record.add(Trace(now_ns, Outcome.DENIED, endpoint, None, header, code, 0, text))
            return None
        self.abandon(authorized, AdsError.ACCESS_DENIED)
        body = b""
        if has_results(request):
            body = request.encode_answer([OperationOutcome(AdsError.ACCESS_DENIED)] * count)
        return RoutingError(AdsError.ACCESS_DENIED, text, outcome=Outcome.DENIED, body=body)

    def _enter(self, entry: AuditEntry) -> None:
        if entry.operations:
            self._entries.append(entry)


def exchange_body(data: bytes, body: bytes) -> bytes:
    """Return a packet with another body."""
    length = len(body).to_bytes(4, "little")
    return data[:_LENGTH] + length + data[_LENGTH + 4 : AmsHeader.SIZE] + body


def _refuse_unreadable(header: AmsHeader, why: AdsRefusedError) -> RoutingError:
    """Return the error for a request that cannot be parsed.

    Only clients with the right RAW may send one, and none if changes have to be recorded.
    """
    text = "the request cannot be read"
    if why.result is AdsError.COMMAND:
        return RoutingError(why.result, text)
    return RoutingError(why.result, text, body=encode_refusal(header.command, why.result))


def _describe(authorized: AuthorizedRequest) -> str:
    first = authorized.denied[0]
    text = f"{first.service} refused: {first.why}"
    if len(authorized.decisions) == 1:
        return text
    return (
        f"{len(authorized.denied)} of {len(authorized.decisions)} items refused, the first: {text}"
    )
