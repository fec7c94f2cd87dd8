"""Restoration of subscriptions whose path to the server was interrupted.

The first router on the path restores: it keeps the parameters of its client.  The others signal the
end of a subscription to the previous router, by the sample without bytes that TwinCAT sends.

Rule 1: a subscription is interrupted when its hop is lost or was started again, when its server
ends it, or when no sample comes for too long and the server does not know it any more.
Rule 2: it is requested again until the server grants it, whatever fails on the path; an error
that says that there is no such object, or that access is refused, ends it, and its client gets a
sample without bytes.
Rule 3: what was granted before is deleted at the server after the new one was granted, and never
while requests for others with the same addresses are pending: a server that was restarted may
give a handle twice.
Rule 4: after a failure one subscription for each pair of addresses tries the path repeatedly; when
it is granted, the others follow in groups.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from heapq import heapify, heappop, heappush
from itertools import count
from typing import NamedTuple, TypeAlias

import msgspec

from eap.ams.error_reply import ErrorReplier, RoutingError
from eap.ams.inflight import InFlight, InvokeIds, Pending, RouterLimits
from eap.ams.notification_forwarder import (
    BY_HANDLE,
    NotificationCleanup,
    header_to,
    symbol_location,
)
from eap.ams.record import Outcome
from eap.ams.routes import Route
from eap.ams.subscriptions import Grant, Subscription, Subscriptions, key_of
from eap.ams.transport_table import Action, TransportTable
from eap.codec.ads import AdsError
from eap.codec.ams import ADDRESSES, AmsCommand, AmsHeader, encode_packet
from eap.ids import Endpoint

RETRY_NS = 500_000_000
"""Between two attempts for one pair of addresses."""
# With many pairs of addresses each is tried less often.
SPACING_NS = 10_000_000
"""Between two requests at all, on the average."""
_LOOKUP_SPACING_NS = 1_000_000
"""Likewise, between two route lookups that fail, which cost no packet."""
GROUP = 32
"""Subscriptions of one pair of addresses that are requested at a time."""
MAX_REQUESTS = 128
"""Requests of restorations that wait for answers."""
TIMEOUT_NS = 2_000_000_000
"""Limit for an answer; then the request is repeated with twice the limit, up to that of requests of
clients: a slow server is restored too."""
STARTUP_TIMEOUT_NS = 5_000_000_000
"""Limit for refusals with an error that may pass, as while a server starts."""
MAX_ENDS = 3
"""Ends of a subscription by its server without a sample between them."""
_SOON_NS = 20_000_000
_MAX_DOUBLINGS = 8
_SPARE_CHECKS = 256
"""Checks of subscriptions that have ended, before they are dropped ahead of their time."""
_GRANTED = 8
"""Bytes of the answer of AddNotification: result and handle."""
_PATH_ERRORS = frozenset(
    (
        AdsError.MAILBOX_FULL, AdsError.TARGET_MACHINE, AdsError.PORT_NOT_CONNECTED,
        AdsError.TCP_SEND, AdsError.HOST_UNREACHABLE, AdsError.NOT_READY, AdsError.BUSY,
        AdsError.NOT_INITIALIZED, AdsError.TIMEOUT, AdsError.PENDING, AdsError.ABORTED,
        AdsError.CLIENT_TIMEOUT,
    )
)  # fmt: skip
"""Errors that say nothing about the object."""
_STARTUP_ERRORS = frozenset(
    (
        AdsError.TARGET_PORT, AdsError.GENERAL, AdsError.NO_MEMORY, AdsError.STATE,
        AdsError.NO_MORE_HANDLES,
    )
)  # fmt: skip
"""Errors that may pass when the server has started, or has forgotten others."""

RouteFinder: TypeAlias = Callable[
    [AmsHeader, bytes, Endpoint, int], tuple[Route, bytes] | RoutingError
]
"""Returns the route of a request now and its forwarded addresses, or an error."""


class _Session:
    """Subscriptions with the same addresses of server and client that are to be established."""

    __slots__ = (
        "addresses",
        "at_ns",
        "endpoint",
        "interrupted_at_ns",
        "is_trying",
        "outstanding",
        "restored",
        "stale",
        "timeouts",
        "waiting",
    )  # fmt: skip

    def __init__(self, endpoint: Endpoint, addresses: bytes, at_ns: int) -> None:
        self.endpoint = endpoint
        self.addresses = addresses
        self.at_ns = at_ns
        self.interrupted_at_ns: int | None = None
        self.restored = 0
        self.is_trying = True
        self.outstanding = 0
        self.timeouts = 0
        self.waiting: deque[Subscription] = deque()
        self.stale: list[tuple[Grant, bool]] = []


class _Step(NamedTuple):
    """A request of a restoration: for the handle of a symbol, for a notification, or its end."""

    session: _Session
    subscription: Subscription | None
    """None for the end of an earlier grant."""
    stale: Grant | None = None
    is_check: bool = False
    """True if it reveals that the server has lost a subscription that seemed alive."""
    symbol_handle: int | None = None


class Interruption(NamedTuple):
    """Subscriptions of one client at one server to which nothing comes."""

    endpoint: Endpoint
    addresses: bytes
    """Addresses of server and client."""
    number: int
    since_ns: int
    why: str


class SubscriptionRestorer:
    """Restores interrupted subscriptions.

    Args:
        subscriptions: All that pass the router.
        transports: By which requests are sent.
        in_flight: What waits for an answer, these requests too.
        ids: Of requests of this router.
        cleanup: Ends grants that are not needed.
        error_replier: Takes note of what is given up.
        limits: How much may wait.
        find_route: Finds the route of a client's request, by the access rules too.
    """

    def __init__(
        self, subscriptions: Subscriptions, transports: TransportTable, in_flight: InFlight,
        ids: InvokeIds, cleanup: NotificationCleanup, error_replier: ErrorReplier,
        limits: RouterLimits, find_route: RouteFinder,
    ) -> None:  # fmt: skip
        self._subscriptions = subscriptions
        self._transports = transports
        self._in_flight = in_flight
        self._ids = ids
        self._cleanup = cleanup
        self._error_replier = error_replier
        self._limits = limits
        self._find_request_route = find_route
        self._sessions: dict[bytes, _Session] = {}
        self._due: list[tuple[int, int, _Session]] = []
        self._checks: list[tuple[int, int, Subscription]] = []
        self._numbers = count()
        self._deleting: set[tuple[bytes, int]] = set()
        self._outstanding = 0

    def watch(self, subscription: Subscription) -> None:
        """Check from time to time whether samples come."""
        if subscription.request is not None:
            if len(self._checks) > 2 * len(self._subscriptions) + _SPARE_CHECKS:
                self._checks = [each for each in self._checks if not each[2].is_closed]
                heapify(self._checks)
            at_ns = subscription.received_at_ns + subscription.quiet_limit_ns()
            heappush(self._checks, (at_ns, next(self._numbers), subscription))

    def granted(self, subscription: Subscription, now_ns: int) -> list[Action]:
        """Watch a new subscription of a client."""
        self.watch(subscription)
        return self._reject_deleted_handle(subscription, now_ns)

    def interrupt(
        self, subscriptions: Iterable[Subscription], why: str, now_ns: int
    ) -> list[Action]:
        """Have subscriptions restored; those that another router restores are ended."""
        actions: list[Action] = []
        for each in subscriptions:
            if each.request is None:
                actions += self._end(each, now_ns)
                continue
            self._subscriptions.suspend(each)
            if each.interrupted_at_ns is None:
                each.interrupted_at_ns, each.why = now_ns, why
                each.refused_at_ns = None
            session = self._queue(each, now_ns)
            if session.interrupted_at_ns is None:
                session.interrupted_at_ns = now_ns
                self._note(session, Outcome.INTERRUPTED, f"interrupted: {why}", now_ns)
        return actions

    def ended(self, subscriptions: Iterable[Subscription], now_ns: int) -> list[Action]:
        """Act on samples without bytes: the server, or a router on the path, ended these."""
        actions: list[Action] = []
        for each in subscriptions:
            if each.is_closed:
                continue
            self._subscriptions.detach(each)
            each.ends += 1
            if each.request is None or each.ends >= MAX_ENDS:
                actions += self._end(each, now_ns)
            else:
                actions += self.interrupt(
                    [each], "its server, or a router on the path, ended it", now_ns
                )
        return actions

    def displaced(self, subscriptions: Iterable[Subscription], now_ns: int) -> list[Action]:
        """Act on handles that a server gave a second time: it forgot what they were before."""
        actions: list[Action] = []
        for each in subscriptions:
            if each.is_closed:
                actions.append(self._transports.reply(each.endpoint, each.encode_end(now_ns)))
            else:
                actions += self.interrupt([each], "its server was started again", now_ns)
        return actions

    def receive_answer(
        self, pending: Pending, header: AmsHeader, body: bytes, now_ns: int
    ) -> list[Action]:
        """Act on the answer to a request of a restoration."""
        step = pending.step
        assert isinstance(step, _Step)  # noqa: S101  for the type
        # An answer came in time: the limit is the short one again.
        step.session.timeouts = 0
        return self._end_step(pending, step, header, body, now_ns)

    def request_failed(self, pending: Pending, error: AdsError, now_ns: int) -> list[Action]:
        """Act on a request of a restoration that nothing came back for."""
        step = pending.step
        assert isinstance(step, _Step)  # noqa: S101  for the type
        step.session.timeouts += error is AdsError.TIMEOUT
        return self._end_step(pending, step, _failed_header(pending.header, error), b"", now_ns)

    def _end_step(
        self, pending: Pending, step: _Step, header: AmsHeader, body: bytes, now_ns: int
    ) -> list[Action]:
        self._outstanding -= 1
        step.session.outstanding -= 1
        error = header.error_code or int.from_bytes(body[:4], "little")
        # An answer without a result counts as a general error, which may pass.
        if len(body) < 4 and not error:
            error = AdsError.GENERAL
        actions: list[Action] = []
        if step.stale is not None:
            actions += self._deleted(step, step.stale, error, now_ns)
        elif step.subscription is not None:
            actions += self._answered(pending, step, error, body, now_ns)
        return actions + self._continue(step.session, now_ns)

    def interruptions(self) -> list[Interruption]:
        """Return the interrupted subscriptions, by client and server."""
        found: dict[tuple[Endpoint, bytes], Interruption] = {}
        for each in self._subscriptions if self._sessions else ():
            since_ns = each.interrupted_at_ns
            if since_ns is None:
                continue
            key = each.endpoint, each.addresses
            known = found.get(key, Interruption(*key, 0, since_ns, each.why))
            found[key] = known._replace(
                number=known.number + 1, since_ns=min(since_ns, known.since_ns)
            )
        return list(found.values())

    def next_timeout(self) -> int | None:
        """Return when :meth:`handle_timeout` has something to do."""
        times = [heap[0][0] for heap in (self._due, self._checks) if heap]
        return min(times, default=None)

    def handle_timeout(self, now_ns: int) -> list[Action]:
        """Ask for what is due, and check what is quiet."""
        actions: list[Action] = []
        while self._checks and self._checks[0][0] <= now_ns:
            self._check(heappop(self._checks)[2], now_ns)
        while self._due and self._due[0][0] <= now_ns:
            at_ns, _, session = heappop(self._due)
            if self._sessions.get(session.addresses) is not session or session.at_ns != at_ns:
                continue
            if not session.outstanding:
                actions += self._begin(session, now_ns)
        return actions

    def _check(self, subscription: Subscription, now_ns: int) -> None:
        if subscription.is_closed:
            return
        at_ns = subscription.received_at_ns + subscription.quiet_limit_ns()
        if subscription.interrupted_at_ns is None and at_ns <= now_ns:
            subscription.checks += 1
            self._queue(subscription, now_ns)
        at_ns = max(at_ns, now_ns + subscription.quiet_limit_ns() // 2)
        heappush(self._checks, (at_ns, next(self._numbers), subscription))

    def _queue(self, subscription: Subscription, now_ns: int) -> _Session:
        session = self._sessions.get(subscription.addresses)
        if session is None:
            session = self._sessions[subscription.addresses] = _Session(
                subscription.endpoint, subscription.addresses, now_ns
            )
            self._schedule(session, now_ns)
        if not subscription.is_queued:
            subscription.is_queued = True
            session.waiting.append(subscription)
        return session

    def _note(self, session: _Session, outcome: Outcome, text: str, now_ns: int) -> None:
        """Have it in the log: once for all subscriptions of a session."""
        header = header_to(session.addresses, AmsCommand.ADD_NOTIFICATION, 0)
        self._error_replier.drop(session.endpoint, header, outcome, text, now_ns)

    def _schedule(self, session: _Session, at_ns: int) -> None:
        session.at_ns = at_ns
        heappush(self._due, (at_ns, next(self._numbers), session))

    def _begin(self, session: _Session, now_ns: int) -> list[Action]:
        """Request one subscription, or a group once one has been granted."""
        actions: list[Action] = []
        # One request finds out whether the server is there again; the others follow by its answer.
        limit = 1 if session.is_trying else GROUP
        while session.waiting and session.outstanding < limit and self._is_below_limits():
            subscription = session.waiting.popleft()
            if subscription.is_closed:
                continue
            actions += self._request(session, subscription, now_ns)
            if session.is_trying and session.at_ns > now_ns:
                break
        return actions + self._continue(session, now_ns)

    def _request(
        self, session: _Session, subscription: Subscription, now_ns: int,
        location: tuple[int, int] | None = None,
    ) -> list[Action]:  # fmt: skip
        request = subscription.request
        assert request is not None  # noqa: S101  for the type
        command, body, symbol_handle = AmsCommand.ADD_NOTIFICATION, request.encode(), None
        is_by_handle = request.group in BY_HANDLE
        if location is not None:
            group, offset = location
            symbol_handle = offset if is_by_handle else None
            group = request.group if is_by_handle else group
            body = group.to_bytes(4, "little") + offset.to_bytes(4, "little") + body[8:]
        elif subscription.symbol:
            # Where a symbol is may be another place since its server was started again.
            command, body = AmsCommand.READ_WRITE, subscription.symbol
        elif is_by_handle:
            text = "the name of its symbol is unknown"
            return self._give_up(session, subscription, text, now_ns)
        step = _Step(session, subscription, symbol_handle=symbol_handle)
        invoke_id = self._ids.allocate(self._in_flight)
        header = header_to(subscription.addresses, command, invoke_id)
        packet = encode_packet(header, body)
        found = self._find_request_route(header, packet, subscription.endpoint, now_ns)
        if isinstance(found, RoutingError):
            return self._failed(
                session, subscription, found.error, found.text, now_ns, _LOOKUP_SPACING_NS
            )
        route, onward = found
        packet = onward + packet[ADDRESSES.size :]
        handles = int(command == AmsCommand.ADD_NOTIFICATION)
        return self._send(step, header, packet, onward, route, handles, now_ns)

    def _send(
        self, step: _Step, header: AmsHeader, packet: bytes, onward: bytes, route: Route,
        handles: int, now_ns: int,
    ) -> list[Action]:  # fmt: skip
        usual_ns = max(TIMEOUT_NS, route.timeout_ns or self._limits.timeout_ns)
        allowed_ns = TIMEOUT_NS << min(step.session.timeouts, _MAX_DOUBLINGS)
        deadline_ns = now_ns + min(allowed_ns, usual_ns)
        pending = Pending(header.invoke_id, header, None, route, onward, now_ns, deadline_ns)
        pending.handles = handles
        pending.step = step
        self._in_flight.add(pending)
        self._outstanding += 1
        step.session.outstanding += 1
        return [self._transports.forward(route.hop, packet, header.invoke_id)]

    def _answered(
        self, pending: Pending, step: _Step, error: int, body: bytes, now_ns: int
    ) -> list[Action]:
        """Act on what a server says to the request for a subscription or a symbol."""
        session, subscription = step.session, step.subscription
        assert subscription is not None  # noqa: S101  for the type
        location = None if pending.handles else symbol_location(subscription.symbol, body)
        if not error and (len(body) < _GRANTED if pending.handles else location is None):
            error = AdsError.GENERAL
        if subscription.is_closed:
            grant = None if error or not pending.handles else _grant_of(pending, step, body)
            return [] if grant is None else self._cleanup.end([grant], now_ns)
        if error:
            route = pending.route
            text = AdsError.words_of(error)
            if route is not None:
                text += f" from {route.name} ({route.hop}) or from behind it"
            failed = self._failed(session, subscription, error, text, now_ns)
            if step.symbol_handle is not None and error not in _PATH_ERRORS:
                failed += self._cleanup.release(_grant_of(pending, step, bytes(_GRANTED)), now_ns)
            return failed
        if not pending.handles:
            return self._request(session, subscription, now_ns, location)
        return self._establish(session, subscription, _grant_of(pending, step, body), now_ns)

    def _establish(
        self, session: _Session, subscription: Subscription, grant: Grant, now_ns: int
    ) -> list[Action]:
        was_interrupted = subscription.interrupted_at_ns is not None
        before = self._subscriptions.detach(subscription)
        displaced = self._subscriptions.attach(subscription, grant)
        subscription.is_queued = False
        subscription.interrupted_at_ns = subscription.refused_at_ns = None
        subscription.why = ""
        # A check of a live subscription makes the server send its value again, which the client
        # has.
        subscription.skips_repeat = not was_interrupted
        subscription.established_at_ns = subscription.received_at_ns = now_ns
        session.is_trying = False
        session.restored += was_interrupted
        if before is not None and key_of(before) != key_of(grant):
            session.stale.append((before, not was_interrupted))
        actions = [] if displaced is None else self.displaced([displaced], now_ns)
        return actions + self._reject_deleted_handle(subscription, now_ns)

    def _reject_deleted_handle(self, subscription: Subscription, now_ns: int) -> list[Action]:
        """Restore a subscription whose handle is that of a notification being deleted."""
        if subscription.grant is None or key_of(subscription.grant) not in self._deleting:
            return []
        self._subscriptions.detach(subscription)
        return self.interrupt([subscription], "its server was started again", now_ns)

    def _failed(
        self, session: _Session, subscription: Subscription, error: int, text: str, now_ns: int,
        spacing_ns: int = SPACING_NS,
    ) -> list[Action]:  # fmt: skip
        """Try again later, or give up."""
        passes = error in _PATH_ERRORS
        if passes:
            subscription.refused_at_ns = None
        elif error in _STARTUP_ERRORS:
            since_ns = subscription.refused_at_ns
            subscription.refused_at_ns = since_ns = now_ns if since_ns is None else since_ns
            passes = now_ns - since_ns < STARTUP_TIMEOUT_NS
        if not passes:
            return self._give_up(session, subscription, text, now_ns)
        # In front: the order of the client's subscriptions is kept.
        session.waiting.appendleft(subscription)
        session.is_trying = True
        self._schedule(session, now_ns + max(RETRY_NS, len(self._sessions) * spacing_ns))
        subscription.why = text
        # What waits for its check has the same server, and nothing comes from it either.
        quiet = [each for each in session.waiting if each.interrupted_at_ns is None]
        return self.interrupt(quiet, text, now_ns)

    def _give_up(
        self, session: _Session, subscription: Subscription, text: str, now_ns: int
    ) -> list[Action]:
        """End what cannot be restored."""
        text = f"the subscription cannot be restored: {text}"
        self._note(session, Outcome.FAILED, text, now_ns)
        grant = self._subscriptions.detach(subscription)
        if grant is not None:
            session.stale.append((grant, False))
        return self._end(subscription, now_ns)

    def _end(self, subscription: Subscription, now_ns: int) -> list[Action]:
        """Remove a subscription, and send its end to the client."""
        self._subscriptions.remove(subscription)
        endpoint = subscription.endpoint
        if endpoint.transport not in self._transports.transports:
            return []
        return [self._transports.reply(endpoint, subscription.encode_end(now_ns))]

    def _continue(self, session: _Session, now_ns: int) -> list[Action]:
        """Delete what was granted before, then ask for more, when all requests are answered."""
        if session.outstanding:
            return []
        actions: list[Action] = []
        stale, session.stale = session.stale, []
        for grant, is_check in stale:
            if self._subscriptions.find(*key_of(grant)) is None:  # else it was given again
                actions += self._delete(session, grant, is_check=is_check, now_ns=now_ns)
        if session.outstanding:
            return actions
        if not session.waiting:
            self._sessions.pop(session.addresses, None)
            if session.restored and session.interrupted_at_ns is not None:
                took_s = (now_ns - session.interrupted_at_ns) / 1e9
                noun = "subscription" if session.restored == 1 else "subscriptions"
                text = f"{session.restored} {noun} restored after {took_s:.1f} s"
                self._note(session, Outcome.RESTORED, text, now_ns)
        elif session.at_ns <= now_ns:
            self._schedule(session, now_ns + _SOON_NS)
        return actions

    def _delete(
        self, session: _Session, grant: Grant, *, is_check: bool, now_ns: int
    ) -> list[Action]:
        if grant.route.hop.transport not in self._transports.transports:
            return []
        self._deleting.add(key_of(grant))
        step = _Step(session, None, grant, is_check)
        invoke_id = self._ids.allocate(self._in_flight)
        header = header_to(grant.onward, AmsCommand.DELETE_NOTIFICATION, invoke_id)
        packet = encode_packet(header, grant.handle.to_bytes(4, "little"))
        actions = self._send(step, header, packet, grant.onward, grant.route, 0, now_ns)
        return actions + self._cleanup.release(grant, now_ns)

    def _deleted(self, step: _Step, grant: Grant, error: int, now_ns: int) -> list[Action]:
        self._deleting.discard(key_of(grant))
        if not step.is_check or error != AdsError.NOTIFICATION_HANDLE:
            return []
        # The server had forgotten what was quiet: others that were granted before are, too.
        server = step.session.addresses[:6]
        for each in self._subscriptions:
            if each.request is not None and each.addresses[:6] == server:
                quiet_ns = now_ns - max(each.established_at_ns, each.received_at_ns)
                if each.interrupted_at_ns is None and quiet_ns > TIMEOUT_NS:
                    self._queue(each, now_ns)
        return []

    def _is_below_limits(self) -> bool:
        if self._outstanding >= MAX_REQUESTS:
            return False
        return len(self._in_flight) < self._limits.in_flight or self._in_flight.drop_abandoned()


def _grant_of(pending: Pending, step: _Step, body: bytes) -> Grant:
    assert pending.route is not None  # noqa: S101  for the type
    handle = int.from_bytes(body[4:8], "little")
    return Grant(pending.onward, handle, pending.route, step.symbol_handle)


def _failed_header(request: AmsHeader, error: AdsError) -> AmsHeader:
    return msgspec.structs.replace(request, error_code=error)
