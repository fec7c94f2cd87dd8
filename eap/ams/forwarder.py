"""Forwarder: sends requests to the next hop and returns their answers.

A forwarded request has an invoke ID of the router's own, so that the IDs of two clients never
collide and a late answer matches no request.  An ID that another router gave is kept: it identifies
a packet that runs in a circle.
"""

from __future__ import annotations

from eap.ams.access import AccessFilter, AuthorizedRequest, exchange_body
from eap.ams.error_reply import ErrorReplier, RoutingError
from eap.ams.hop_prober import HopProber
from eap.ams.inflight import (
    Admission,
    InFlight,
    InvokeIds,
    LoopDetector,
    Pending,
    RouterLimits,
    is_marked,
)
from eap.ams.notification_forwarder import (
    TRACKED_COMMANDS,
    NotificationCleanup,
    NotificationForwarder,
    Samples,
    deleted_handles,
    encode_deleted,
)
from eap.ams.record import Outcome, Record, Trace, describe
from eap.ams.report import RouteState
from eap.ams.routes import Route, RouteTable
from eap.ams.subscription_restorer import SubscriptionRestorer
from eap.ams.subscriptions import MAX_PER_CLIENT, MAX_TOTAL, Subscription
from eap.ams.transport_table import Action, TransportTable
from eap.codec.ads import AdsError
from eap.codec.ams import ADDRESSES, AmsAnswer, AmsCommand, AmsHeader, response_to
from eap.ids import Endpoint, NetId

_NOTIFICATION = AmsCommand.NOTIFICATION.value  # taken once: members of enums are slow
_ANSWERED = Outcome.ANSWERED
_HALF = ADDRESSES.size // 2
_INVOKE_ID = 28
"""Offset in a packet; the bytes between the addresses and it are forwarded unchanged."""


class Forwarder:
    """Forwards requests, answers and notifications of a router.

    Attributes:
        admission: Finds routes, and knows the hops that are down.
        in_flight: Requests that wait for an answer.
        notification_forwarder: Notifications across this router.
        subscription_restorer: Subscriptions that are interrupted.
    """

    def __init__(
        self,
        net_id: NetId,
        table: RouteTable,
        transports: TransportTable,
        error_replier: ErrorReplier,
        record: Record,
        access_filter: AccessFilter,
        *,
        first_invoke_id: int,
        limits: RouterLimits,
        hop_prober: HopProber | None = None,
    ) -> None:
        self.in_flight = InFlight()
        self.notification_forwarder = NotificationForwarder(transports)
        self._table = table
        self._transports = transports
        self._error_replier = error_replier
        self._record = record
        self._access_filter = access_filter
        self._limits = limits
        self._hop_prober = hop_prober
        self._ids = InvokeIds(first_invoke_id)
        self.admission = Admission(
            net_id, table, transports.transports, self.in_flight, limits, hop_prober
        )
        self._loop_detector = LoopDetector()
        self._cleanup = NotificationCleanup(transports, self.in_flight, self._ids, limits)
        self.subscription_restorer = SubscriptionRestorer(
            self.notification_forwarder.subscriptions, transports, self.in_flight, self._ids,
            self._cleanup, error_replier, limits, self._find_request_route,
        )  # fmt: skip
        if hop_prober is not None:
            hop_prober.watched = self.notification_forwarder.subscriptions.hops

    def forward_notification(
        self, header: AmsHeader, data: bytes, endpoint: Endpoint, now_ns: int, *, is_own: bool
    ) -> list[Action]:
        """Send samples to the clients that subscribed, whatever NetID these have.

        Samples that no client here subscribed to are forwarded by a route.  Without a route, or if
        its client does not listen, the server is requested to end them.

        Args:
            header: Of the notification.
            data: All of the packet.
            endpoint: That it arrived by.
            now_ns: The time on the monotonic clock.
            is_own: Whether its target is of this station.

        Raises:
            CodecError: it is shorter or longer than it says.
        """
        samples = self.notification_forwarder.distribute(
            header, data, now_ns, lambda hop: self._transports.is_from(hop, endpoint)
        )
        if samples.hop is not None:
            if self._hop_prober is not None:
                self._hop_prober.note_answer(samples.hop, now_ns)
            actions = [*samples.replies, *self.subscription_restorer.ended(samples.ended, now_ns)]
            return actions + self._end_unwanted(header, samples, endpoint)
        found = None if is_own else self.admission.find_route(header, endpoint)
        if found is not None and not self._is_refused_for_good(found):
            return self.forward_request(header, data, endpoint, now_ns)
        text = "no client here subscribed to it, or not any more"
        self._error_replier.drop(endpoint, header, Outcome.LATE, text, now_ns)
        return self._end_unwanted(header, samples, endpoint)

    def _is_refused_for_good(self, found: Route | RoutingError) -> bool:
        """Return whether samples for a client that is not connected here can never reach it."""
        if isinstance(found, Route):
            return False
        if found.error == AdsError.TARGET_MACHINE:
            return True
        # A client that does not listen gets samples by its own connection only, and that has ended.
        obstacle = None if found.route is None else self.admission.find_obstacle(found.route)
        return obstacle is not None and obstacle.state is RouteState.CLIENT

    def _end_unwanted(
        self, header: AmsHeader, samples: Samples, endpoint: Endpoint
    ) -> list[Action]:
        """End one notification that no client has; the others follow with their next samples."""
        if not samples.unknown:
            return []
        return self._cleanup.end_unwanted(header, samples.unknown[0], endpoint)

    def forward_request(
        self, header: AmsHeader, data: bytes, endpoint: Endpoint, now_ns: int
    ) -> list[Action]:
        """Forward a request to another station, or reply with an error."""
        # Only three commands can concern notifications; the others skip the parsing of their body.
        is_tracked = header.command in TRACKED_COMMANDS
        own = (
            self.notification_forwarder.find_deleted(header, data, endpoint) if is_tracked else None
        )
        # A subscription that this router restores is ended here: its path may be down just now.
        if own is not None and own[0].request is not None:
            return self._delete(header, data, own, endpoint, now_ns)
        found = self._authorize(header, data, endpoint, now_ns)
        if isinstance(found, RoutingError):
            return self._error_replier.reply_error(header, endpoint, found, now_ns)
        route, data, authorized = found
        if own is not None:
            self.notification_forwarder.forget(own)
        if is_tracked and not self.notification_forwarder.is_within_limits(header, data, endpoint):
            return self._refuse_subscriptions(header, authorized, endpoint, now_ns)
        onward = self._onward(header, endpoint, route)
        if not header.wants_answer:
            if authorized is not None:
                self._access_filter.abandon(authorized)
            return self._forward_once(header, data, onward, endpoint, route, now_ns)
        pending = self._admit(header, data, onward, endpoint, route, authorized, now_ns)
        if not isinstance(pending, Pending):
            return pending
        if is_tracked:
            self.notification_forwarder.track_request(pending, data[AmsHeader.SIZE :], endpoint)
        return [self._forward(pending.invoke_id, data, onward, route)]

    def wait_for_service(
        self,
        header: AmsHeader,
        data: bytes,
        endpoint: Endpoint,
        authorized: AuthorizedRequest | None,
        now_ns: int,
    ) -> int | list[Action]:
        """Add a request to a service of this station; return its ticket, or an error reply."""
        pending = self._admit(
            header, data, data[: ADDRESSES.size], endpoint, None, authorized, now_ns
        )
        return pending.invoke_id if isinstance(pending, Pending) else pending

    def return_answer(
        self, header: AmsHeader, data: bytes, endpoint: Endpoint, now_ns: int
    ) -> list[Action]:
        """Return an answer to its client, unless it is late or from another hop."""
        pending = self.in_flight.get(header.invoke_id)
        # An ID alone is no proof: hop, command and addresses have to be those of the request.
        if pending is None or not self._is_answer(header, data, endpoint, pending):
            return self._error_replier.drop(
                endpoint, None, Outcome.LATE, _describe_late(header), now_ns
            )
        self.in_flight.pop(header.invoke_id)
        if self._hop_prober is not None and pending.route is not None:
            self._hop_prober.note_answer(pending.route.hop, now_ns)
        if pending.step is not None:
            body = data[AmsHeader.SIZE :]
            return self.subscription_restorer.receive_answer(pending, header, body, now_ns)
        actions: list[Action] = []
        granted = None
        if pending.handles or pending.request_body:
            body = data[AmsHeader.SIZE :]
            granted = self.notification_forwarder.track_answer(pending, header, body, now_ns)
        if granted is not None:
            actions += self._cleanup.end(granted.surplus, now_ns)
            actions += self.subscription_restorer.displaced(granted.displaced, now_ns)
            data = data[: AmsHeader.SIZE] + granted.body
        if pending.endpoint is None:
            if header.command != AmsCommand.DELETE_NOTIFICATION:  # most of those are our own
                self._error_replier.drop(
                    endpoint, None, Outcome.LATE, _describe_late(header), now_ns
                )
            return actions
        request = pending.header
        if pending.authorized is not None:
            body = data[AmsHeader.SIZE :]
            body = self._access_filter.complete(pending.authorized, header.error_code, body)
            data = exchange_body(data, body)
        back = ADDRESSES.pack(
            request.source, request.source_port, request.target, request.target_port
        )
        number = request.invoke_id.to_bytes(4, "little")
        packet = back + data[ADDRESSES.size : _INVOKE_ID] + number + data[AmsHeader.SIZE :]
        actions += self._send_back(pending, pending.endpoint, packet, header.error_code, now_ns)
        for subscription in () if granted is None else granted.new:
            actions += self.subscription_restorer.granted(subscription, now_ns)
        return actions

    def answer_now(
        self, header: AmsHeader, endpoint: Endpoint, answer: AmsAnswer, took_ns: int, now_ns: int
    ) -> list[Action]:
        """Return the immediate answer of a service."""
        packet = response_to(header, answer)
        trace = Trace(now_ns, _ANSWERED, endpoint, None, header, 0, took_ns, "")
        self._record.add_answered(trace, endpoint, None, len(packet))
        return [self._transports.reply(endpoint, packet)]

    def answer(self, ticket: int, answer: AmsAnswer, now_ns: int) -> list[Action]:
        """Return the answer of a service to the request with *ticket*, if it still waits."""
        pending = self.in_flight.get(ticket)
        if pending is None or pending.route is not None or pending.endpoint is None:
            return []
        self.in_flight.pop(ticket)
        if pending.authorized is not None:
            body = self._access_filter.complete(pending.authorized, answer.error_code, answer.data)
            answer = answer._replace(data=body)
        packet = response_to(pending.header, answer)
        why = _with_result(answer)
        return self._send_back(pending, pending.endpoint, packet, answer.error_code, now_ns, why)

    def send_failed(self, ticket: int, text: str, now_ns: int) -> list[Action]:
        """Reply to a request that its transport could not send."""
        pending = self.in_flight.pop(ticket)
        return [] if pending is None else self._fail(pending, text, now_ns)

    def endpoints_of(self, transport: str) -> set[Endpoint]:
        """Return the endpoints of a transport with pending requests or subscriptions."""
        endpoints = {
            *self.in_flight.endpoints(),
            *self.notification_forwarder.subscriptions.endpoints(),
        }
        return {endpoint for endpoint in endpoints if endpoint.transport == transport}

    def connection_closed(self, endpoint: Endpoint, now_ns: int) -> list[Action]:
        """Forget the requests of *endpoint*, and end its notifications."""
        # Forwarded requests stay until their deadline: without them a loop would not be found.
        for pending in self.in_flight.abandon(endpoint):
            self._give_up(pending)
            if pending.route is None:
                self.in_flight.pop(pending.invoke_id)
        return self._cleanup.end(self.notification_forwarder.close(endpoint), now_ns)

    def hop_down(self, transport: str, address: str | None, text: str, now_ns: int) -> list[Action]:
        """Fail the pending requests of a hop, and all later ones until it is up."""
        self.admission.hop_down(transport, address, text)
        return self.hop_lost(transport, address, text, now_ns)

    def hop_lost(self, transport: str, address: str | None, text: str, now_ns: int) -> list[Action]:
        """Fail the pending requests of a hop."""
        actions = self.subscriptions_lost(transport, address, text, now_ns)
        for pending in self.in_flight.on(transport, address):
            self.in_flight.pop(pending.invoke_id)
            actions += self._fail(pending, text, now_ns)
        return actions

    def subscriptions_lost(
        self, transport: str, address: str | None, text: str, now_ns: int
    ) -> list[Action]:
        """Restore the subscriptions by a hop, or end them at the previous router."""
        lost = self.notification_forwarder.subscriptions.of_hop(transport, address)
        return self.subscription_restorer.interrupt(lost, text, now_ns)

    def next_timeout(self) -> int | None:
        """Return when :meth:`handle_timeout` has something to do."""
        times = (self.in_flight.next_timeout(), self.subscription_restorer.next_timeout())
        return min((each for each in times if each is not None), default=None)

    def handle_timeout(self, now_ns: int) -> list[Action]:
        """Reply to requests whose time-out has passed."""
        actions: list[Action] = []
        for pending in self.in_flight.due(now_ns):
            self.in_flight.pop(pending.invoke_id)
            if pending.endpoint is not None or pending.step is not None:
                actions += self._time_out(pending, now_ns)
        return actions + self.subscription_restorer.handle_timeout(now_ns)

    def _find_request_route(
        self, header: AmsHeader, packet: bytes, endpoint: Endpoint, now_ns: int
    ) -> tuple[Route, bytes] | RoutingError:
        """Return the route of a client's request now, and the addresses that it is sent with."""
        found = self._authorize(header, packet, endpoint, now_ns)
        if isinstance(found, RoutingError):
            return found
        # The restorer sends the request itself, so nothing is audited by its answer.
        route, _, authorized = found
        if authorized is not None:
            self._access_filter.abandon(authorized)
        return route, self._onward(header, endpoint, route)

    def _onward(self, header: AmsHeader, endpoint: Endpoint, route: Route) -> bytes:
        return ADDRESSES.pack(
            route.to_real(header.target), header.target_port,
            self._table.to_virtual(header.source, endpoint), header.source_port,
        )  # fmt: skip

    def _delete(
        self,
        header: AmsHeader,
        data: bytes,
        own: list[Subscription],
        endpoint: Endpoint,
        now_ns: int,
    ) -> list[Action]:
        """End subscriptions that this router restores, even if their hop is down."""
        known = {each.handle for each in own}
        handles = deleted_handles(header, data)
        grants = self.notification_forwarder.forget(own)
        actions: list[Action] = []
        if header.wants_answer:
            results = [
                AdsError.NONE if each in known else AdsError.NOTIFICATION_HANDLE for each in handles
            ]
            answer = AmsAnswer(encode_deleted(header, results))
            actions += self.answer_now(header, endpoint, answer, 0, now_ns)
        return actions + self._cleanup.end(grants, now_ns)

    def _refuse_subscriptions(
        self,
        header: AmsHeader,
        authorized: AuthorizedRequest | None,
        endpoint: Endpoint,
        now_ns: int,
    ) -> list[Action]:
        if authorized is not None:
            self._access_filter.abandon(authorized, AdsError.NO_MORE_HANDLES)
        text = f"no more than {MAX_PER_CLIENT} notifications a client, {MAX_TOTAL} in all"
        # In the body, not in the AMS header: the target can be reached, but refuses.
        body = AdsError.NO_MORE_HANDLES.to_bytes(4, "little") + bytes(4)
        why = RoutingError(AdsError.NO_MORE_HANDLES, text, body=body)
        return self._error_replier.reply_error(header, endpoint, why, now_ns)

    def _authorize(
        self, header: AmsHeader, data: bytes, endpoint: Endpoint, now_ns: int
    ) -> tuple[Route, bytes, AuthorizedRequest | None] | RoutingError:
        """Return the route of a request, its packet and its authorization, or an error."""
        route = self.admission.find_route(header, endpoint)
        if isinstance(route, RoutingError):
            return route
        through = self._access_filter.filter_request(header, data, endpoint, now_ns, route.name)
        return through if isinstance(through, RoutingError) else (route, *through)

    def _admit(
        self, header: AmsHeader, data: bytes, onward: bytes, endpoint: Endpoint,
        route: Route | None, authorized: AuthorizedRequest | None, now_ns: int,
    ) -> Pending | list[Action]:  # fmt: skip
        """Add a request that has an answer, unless a limit or a loop forbids it."""
        # UDP and Ethernet may double packets: the copy is dropped, the original is answered.
        if self.admission.is_duplicate(header, onward, endpoint):
            if authorized is not None:
                self._access_filter.abandon(authorized)
            text = "the same request waits already"
            return self._error_replier.drop(endpoint, header, Outcome.DROPPED, text, now_ns)
        why = None if route is None else self.admission.find_loop(header, onward, route)
        why = why or self.admission.check_limits(endpoint)
        if why is not None:
            if authorized is not None:
                self._access_filter.abandon(authorized, why.error)
            return self._error_replier.reply_error(header, endpoint, why, now_ns)
        invoke_id = header.invoke_id
        # The ID of another router is kept, so that a loop is found, unless it is in use here.
        if route is None or not is_marked(invoke_id) or invoke_id in self.in_flight:
            invoke_id = self._ids.allocate(self.in_flight)
        allowed = self._limits.timeout_ns
        if route is not None:
            allowed = route.timeout_ns or allowed
            self._record.add_forwarded(route.key, len(data), now_ns)
        pending = Pending(
            invoke_id, header, endpoint, route, onward, now_ns, now_ns + allowed,
            may_repeat=self.admission.may_repeat(endpoint),
        )  # fmt: skip
        pending.authorized = authorized
        self.in_flight.add(pending)
        return pending

    def _forward_once(
        self,
        header: AmsHeader,
        data: bytes,
        onward: bytes,
        endpoint: Endpoint,
        route: Route,
        now_ns: int,
    ) -> list[Action]:
        """Forward a packet without an answer, unless it was forwarded a short time ago."""
        invoke_id = header.invoke_id
        if is_marked(invoke_id):
            if (invoke_id, onward) in self._loop_detector:
                text = f"forwarded already: doubled, or routes to {header.target} run in a circle"
                return self._error_replier.drop(endpoint, header, Outcome.LOOP, text, now_ns)
        else:
            invoke_id = self._ids.allocate(self.in_flight)
        self._loop_detector.add(invoke_id, onward)
        self._record.add_forwarded(route.key, len(data), now_ns)
        return [self._forward(invoke_id, data, onward, route)]

    def _forward(self, invoke_id: int, data: bytes, onward: bytes, route: Route) -> Action:
        number = invoke_id.to_bytes(4, "little")
        packet = onward + data[ADDRESSES.size : _INVOKE_ID] + number + data[AmsHeader.SIZE :]
        return self._transports.forward(route.hop, packet, invoke_id)

    def _is_answer(
        self, header: AmsHeader, data: bytes, endpoint: Endpoint, pending: Pending
    ) -> bool:
        return (
            pending.route is not None
            and self._transports.is_from(pending.route.hop, endpoint)
            and header.command == pending.header.command
            and data[:_HALF] == pending.onward[_HALF:]
        )

    def _send_back(
        self, pending: Pending, endpoint: Endpoint, packet: bytes, error_code: int, now_ns: int,
        why: str = "",
    ) -> list[Action]:  # fmt: skip
        route, header = pending.route, pending.header
        took_ns = now_ns - pending.at_ns
        hop = None if route is None else route.hop
        if not (error_code or why):
            trace = Trace(now_ns, _ANSWERED, endpoint, hop, header, 0, took_ns, "")
            key = None if route is None else route.key
            self._record.add_answered(trace, endpoint, key, len(packet))
            return [self._transports.reply(endpoint, packet)]
        if error_code and not why:
            why = f"{AdsError.words_of(error_code)} from a service of this station"
        if route is not None:
            traffic = self._record.routes.of(route.key, now_ns)
            if error_code:
                error = AdsError.words_of(error_code)
                why = f"{error} from {self._table.describe_hop(route)} or from behind it"
                traffic.add_error(why, now_ns)
            traffic.add_answer(len(packet), took_ns)
        text = f"{describe(header, endpoint)}: {why}"
        connection = self._record.connections.of(endpoint, now_ns)
        if error_code:
            connection.add_error(text, now_ns)
        connection.add_answer(len(packet), took_ns)
        self._record.add(Trace(now_ns, _ANSWERED, endpoint, hop, header, error_code, took_ns, text))
        return [self._transports.reply(endpoint, packet)]

    def _fail(self, pending: Pending, text: str, now_ns: int) -> list[Action]:
        if pending.step is not None:
            return self.subscription_restorer.request_failed(
                pending, AdsError.HOST_UNREACHABLE, now_ns
            )
        if pending.route is None or pending.endpoint is None:
            return []
        route = pending.route
        why = RoutingError(
            AdsError.HOST_UNREACHABLE, f"{self._table.describe_hop(route)}: {text}", route
        )
        return self._refuse(pending, why, now_ns)

    def _time_out(self, pending: Pending, now_ns: int) -> list[Action]:
        if pending.step is not None:
            actions = self.subscription_restorer.request_failed(pending, AdsError.TIMEOUT, now_ns)
        else:
            allowed_s = (pending.deadline_ns - pending.at_ns) / 1e9
            route = pending.route
            target = "its service" if route is None else self._table.describe_beyond(route)
            why = RoutingError(
                AdsError.TIMEOUT, f"no answer from {target} within {allowed_s:g} s", route
            )
            actions = self._refuse(pending, why, now_ns)
        if pending.handles:
            # If it is granted after all, it has to be ended.
            pending.endpoint, pending.step, pending.at_ns = None, None, now_ns
            pending.deadline_ns = now_ns + self._limits.timeout_ns
            self.in_flight.add(pending)
        return actions

    def _refuse(self, pending: Pending, why: RoutingError, now_ns: int) -> list[Action]:
        """Reply with an error to a request without an answer."""
        self._give_up(pending, why.error)
        took_ns = now_ns - pending.at_ns
        return self._error_replier.reply_error(
            pending.header, pending.endpoint, why, now_ns, took_ns
        )

    def _give_up(self, pending: Pending, error_code: int | None = None) -> None:
        if pending.authorized is not None:
            self._access_filter.abandon(pending.authorized, error_code)
            pending.authorized = None


def _with_result(answer: AmsAnswer) -> str:
    """Return why a service refused something, with the result of the whole if it has one."""
    result = int.from_bytes(answer.data[:4], "little")
    return f"{answer.why} (0x{result:x})" if answer.why and result else answer.why


def _describe_late(answer: AmsHeader) -> str:
    return (
        f"an answer of {answer.source}:{answer.source_port} to {answer.target}:{answer.target_port}"
        " that no request waits for"
    )
