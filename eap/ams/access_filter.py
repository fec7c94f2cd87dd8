"""The gate of a router: what goes in or on by the access rules, item by item in a sum command.

Whoever keeps an audit takes from here what was changed and what was refused.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from eap.ads.endpoint import Endpoint
from eap.ads.operation import AdsRefusedError, OperationOutcome
from eap.ads.part import has_results
from eap.ads.request import encode_refusal, parse_request
from eap.ams.access import LOOKUPS, AccessList
from eap.ams.action import Outcome, Trace
from eap.ams.authorized_request import AuditEntry, AuthorizedRequest
from eap.ams.error_reply import Refusal
from eap.ams.record import Record, describe
from eap.ams.spec import AccessService
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import AmsCommand, AmsHeader

MAX_ENTRIES = 4096
"""Entries of the audit that wait for somebody who writes them down; the oldest makes room."""
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
"""Where the header says how long the body is."""


class AccessFilter:
    """Judges requests.

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
        """Whether :meth:`next_entry` has one."""
        return bool(self._entries)

    def next_entry(self) -> AuditEntry | None:
        """Take the oldest entry of the audit."""
        return self._entries.popleft() if self._entries else None

    def may(self, header: AmsHeader, endpoint: Endpoint) -> dict[AccessService, bool | None]:
        """Return what a client may do with its target; None if that depends on the object."""
        grants = self.access.grants(endpoint, header.source, header.target, header.target_port)
        return {service: grants.may(service) for service in AccessService}

    def is_this_host(self, endpoint: Endpoint) -> bool:
        """Say whether only a program of this host can have come by *endpoint*."""
        return self.access.is_this_host(endpoint)

    def let_through(
        self, header: AmsHeader, data: bytes, endpoint: Endpoint, now_ns: int, route: str = ""
    ) -> tuple[bytes, AuthorizedRequest | None] | Refusal:
        """Return a request as it goes in or on, and what to do with its answer, or refuse it.

        Args:
            header: As it came.
            data: All of the packet.
            endpoint: That it came by.
            now_ns: The time on the monotonic clock.
            route: Name of the route that it would go on by.
        """
        if header.command == _NOTIFICATION:
            return data, None  # nobody gets one who has not asked for it
        grants = self.access.grants(endpoint, header.source, header.target, header.target_port)
        if grants.may_read and (
            header.command in _READS
            or (header.command == _READ_WRITE and data[_GROUP] in _READ_GROUPS)
        ):
            return data, None
        try:
            request = parse_request(header.command, data[AmsHeader.SIZE :])
        except AdsRefusedError as exc:
            is_recorded = self.before_change is not None
            may_pass = grants.may(AccessService.RAW) and not is_recorded
            return (data, None) if may_pass else _refuse_unreadable(header, exc)
        decisions = tuple(map(grants.admission, request.operations))
        authorized = AuthorizedRequest(endpoint, header, route, request, decisions)
        if why := self._record_first(authorized):
            authorized = authorized.refuse_changes(why)
        if authorized.refused:
            return self._refuse(authorized, now_ns) or (
                exchange_body(data, authorized.encode_part()),
                authorized,
            )
        is_read = all(each.service is AccessService.READ for each in decisions)
        return data, None if is_read else authorized

    def take_answer(self, authorized: AuthorizedRequest, error_code: int, body: bytes) -> bytes:
        """Return the body of the answer that the client gets to all it asked for."""
        body, entry = authorized.take_answer(error_code, body)
        self._enter(entry)
        return body

    def give_up(self, authorized: AuthorizedRequest, error_code: int | None = None) -> None:
        """Take note that nothing came back; *error_code* is what the client got, if anything."""
        self._enter(authorized.give_up(error_code))

    def _record_first(self, authorized: AuthorizedRequest) -> str:
        """Record what a request is going to change, where that is required; return why not."""
        if self.before_change is None:
            return ""
        changes = authorized.changes
        return self.before_change(changes) if changes.operations else ""

    def _refuse(self, authorized: AuthorizedRequest, now_ns: int) -> Refusal | None:
        """Refuse a request as a whole, unless some of its items may be done."""
        request, text = authorized.request, _describe(authorized)
        count = len(authorized.decisions)
        if has_results(request) and len(authorized.refused) < count:
            header, endpoint, code = authorized.header, authorized.endpoint, AdsError.ACCESS_DENIED
            text = f"{describe(header, endpoint)}: {text}"
            self._record.enter(Trace(now_ns, Outcome.DENIED, endpoint, None, header, code, 0, text))
            return None
        self.give_up(authorized, AdsError.ACCESS_DENIED)
        body = b""
        if has_results(request):
            body = request.encode_answer([OperationOutcome(AdsError.ACCESS_DENIED)] * count)
        return Refusal(AdsError.ACCESS_DENIED, text, outcome=Outcome.DENIED, body=body)

    def _enter(self, entry: AuditEntry) -> None:
        if entry.operations:
            self._entries.append(entry)


def exchange_body(data: bytes, body: bytes) -> bytes:
    """Return a packet with another body."""
    length = len(body).to_bytes(4, "little")
    return data[:_LENGTH] + length + data[_LENGTH + 4 : AmsHeader.SIZE] + body


def _refuse_unreadable(header: AmsHeader, why: AdsRefusedError) -> Refusal:
    """Return the refusal of a request that nobody here understands.

    Only clients that may send anything get it through, and nobody where changes are recorded.
    """
    text = "the request cannot be read"
    if why.result is AdsError.COMMAND:
        return Refusal(why.result, text)
    return Refusal(why.result, text, body=encode_refusal(header.command, why.result))


def _describe(authorized: AuthorizedRequest) -> str:
    first = authorized.refused[0]
    text = f"{first.service} refused: {first.why}"
    if len(authorized.decisions) == 1:
        return text
    return (
        f"{len(authorized.refused)} of {len(authorized.decisions)} items refused, the first: {text}"
    )
