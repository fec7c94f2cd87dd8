"""The router of a station: AMS packets to its own services and to the next station (ETG.1020).

Every request is answered exactly once, on the connection that it arrived by: by its target, or with
an error of the AMS header that says why it did not get there.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable
from typing import TypeAlias

from eap.ams.access import AccessFilter, AccessList
from eap.ams.error_reply import ErrorReplier, RoutingError
from eap.ams.forwarder import Forwarder
from eap.ams.hop_prober import MISSES, HopProber
from eap.ams.inflight import RouterLimits
from eap.ams.reassembly import Reassembly
from eap.ams.record import Outcome, Record, Stats, Trace
from eap.ams.report import ConnectionReport, Location, Obstacle, RouteReport, report_route
from eap.ams.routes import Route, RouteTable
from eap.ams.subscription_restorer import Interruption
from eap.ams.transport_table import Action, Deliver, Reply, Transport, TransportTable
from eap.codec.ads import AdsError
from eap.codec.ams import AmsAnswer, AmsCommand, AmsHeader, StateFlags, decode_packet
from eap.errors import CodecError, MalformedError
from eap.ids import Endpoint, NetId, endpoint_of

_RESPONSE = StateFlags.RESPONSE.value  # plain numbers: enums and operators of flags are slow
_FRAGMENT = AmsCommand.FRAGMENT.value
_NOTIFICATION = AmsCommand.NOTIFICATION.value
_PLC_PORTS = frozenset((801, 811, 821, 831, *range(851, 860)))
"""Of the runtimes of TwinCAT 2 and 3."""
_NO_TICKET = 0
"""Ticket of a request that has no answer."""


AnswerNow: TypeAlias = Callable[[AmsHeader, bytes, Endpoint], tuple[AmsAnswer, int] | None]
"""Returns the answer to a request, with its header, body and origin, and how many nanoseconds it
took; None to have the request delivered."""


class Router:
    """Router of one station: handles every received packet.

    Args:
        net_id: Of the router itself.
        table: The routes; they may change at any time.
        transports: By which packets come and go.
        first_invoke_id: Another one at each start, see :class:`~eap.ams.inflight.InvokeIds`.
        limits: How much it takes on.
        hop_prober: Finds dead hops; without one only transports report them.
        access: Access rules; without any other hosts only read.
        answer_now: Answers what a service of this station has at hand: then there is no ``Deliver``
            and nothing waits.

    Attributes:
        record: Traces, counters and traffic.
        access_filter: Applies the access rules, and collects audit entries.
    """

    def __init__(
        self,
        net_id: NetId,
        table: RouteTable,
        transports: Iterable[Transport],
        *,
        first_invoke_id: int,
        limits: RouterLimits | None = None,
        hop_prober: HopProber | None = None,
        access: AccessList | None = None,
        answer_now: AnswerNow | None = None,
    ) -> None:
        self.record = Record()
        self.access_filter = AccessFilter(access or AccessList(), self.record)
        self._table = table
        self._transports = TransportTable(transports)
        self._error_replier = ErrorReplier(self._transports, self.record)
        self._hop_prober = hop_prober
        self._gone: list[Endpoint] = []
        self._answer_now = answer_now
        self._devices: dict[NetId, Container[int]] = {}
        self._fragments = Reassembly()
        self._forwarder = Forwarder(
            net_id, table, self._transports, self._error_replier, self.record, self.access_filter,
            first_invoke_id=first_invoke_id, limits=limits or RouterLimits(), hop_prober=hop_prober,
        )  # fmt: skip

    def add_device(self, net_id: NetId, ports: Container[int]) -> None:
        """Let services answer for *net_id*; *ports* says at any time which AMS ports it has."""
        self._devices[net_id] = ports

    def remove_device(self, net_id: NetId) -> None:
        """Let no service answer for *net_id* any more."""
        del self._devices[net_id]

    def endpoints_of(self, transport: str) -> set[Endpoint]:
        """Return the endpoints of the clients behind a transport."""
        clients = {
            each for each in self.record.connections.snapshot() if each.transport == transport
        }
        return clients | self._forwarder.endpoints_of(transport)

    def add_transport(self, transport: Transport) -> None:
        """Add *transport*; raises ValueError as :meth:`TransportTable.add`."""
        self._transports.add(transport)

    def remove_transport(self, name: str, now_ns: int) -> list[Action]:
        """Remove a transport with its clients; reply to the requests that wait for its hops."""
        actions: list[Action] = []
        for endpoint in self.endpoints_of(name):
            actions += self.connection_closed(*endpoint, now_ns)
        actions += self._forwarder.hop_lost(name, None, f"{name} is there no more", now_ns)
        self._forwarder.admission.transport_removed(name)
        self._transports.remove(name)
        return actions

    def set_hop_connection(self, transport: str, address: str, connection: str) -> None:
        """Treat packets from *connection* as packets of the hop *address*."""
        self._transports.set_connection(Endpoint(transport, address), connection)

    def is_waiting_for(self, header: AmsHeader, body: bytes, transport: str) -> bool:
        """Return whether a client of this router waits for a packet: the answer or the sample.

        This serves those that have several routers behind one socket.  The target does not say it:
        clients may have the NetID of any router.
        """
        if header.state_flags & _RESPONSE:
            pending = self._forwarder.in_flight.get(header.invoke_id)
            return (
                pending is not None
                and pending.route is not None
                and (pending.route.hop.transport == transport)
            )
        is_notification = header.command == _NOTIFICATION
        return is_notification and self._forwarder.notification_forwarder.knows(header, body)

    def receive_packet(
        self,
        data: bytes,
        transport: str,
        connection: str,
        now_ns: int,
        *,
        is_broadcast: bool = False,
    ) -> list[Action]:
        """Act on a packet, or on the fragment of one; nothing that a peer sends raises.

        Args:
            data: Header and what follows it.
            transport: That it arrived by.
            connection: That it arrived by, or its sender's address.
            now_ns: The time on the monotonic clock.
            is_broadcast: Whether other routers got it too: then only its target answers.
        """
        endpoint = endpoint_of(transport, connection)
        try:
            header = AmsHeader.decode(data)
            end = AmsHeader.SIZE + header.length
            if header.command == _FRAGMENT or len(data) != end:
                _, body = decode_packet(data)
                if header.command == _FRAGMENT:
                    return self._receive_fragment(
                        header, bytes(body), endpoint, now_ns, is_broadcast=is_broadcast
                    )
                data = data[:end]
            return self._receive_whole(header, data, endpoint, now_ns, is_broadcast=is_broadcast)
        except CodecError as exc:
            return self._error_replier.drop(endpoint, None, Outcome.DROPPED, str(exc), now_ns)

    def receive_answer(self, ticket: int, answer: AmsAnswer, now_ns: int) -> list[Action]:
        """Send back what a service of this station says to the request with *ticket*.

        What comes after its time, or after its connection was closed, is dropped.
        """
        return self._forwarder.answer(ticket, answer, now_ns)

    def send_failed(self, ticket: int, text: str, now_ns: int) -> list[Action]:
        """Reply to the request with *ticket*, which was not sent for the reason *text*."""
        return self._forwarder.send_failed(ticket, text, now_ns)

    def connection_closed(self, transport: str, connection: str, now_ns: int) -> list[Action]:
        """Forget the clients of a closed connection, and end their notifications."""
        endpoint = Endpoint(transport, connection)
        self._fragments.forget(endpoint)
        self.record.connections.forget(endpoint)
        return self._forwarder.connection_closed(endpoint, now_ns)

    def hop_down(self, transport: str, address: str | None, text: str, now_ns: int) -> list[Action]:
        """Answer what waits for *address*, and what will be for it, with "host unreachable".

        Args:
            transport: By which it is reached.
            address: None for all that are reached by the transport.
            text: Reason, for operators.
            now_ns: The time on the monotonic clock.
        """
        if self._hop_prober is not None:
            self._hop_prober.pause(transport, address)
        return self._forwarder.hop_down(transport, address, text, now_ns)

    def hop_up(self, transport: str, address: str | None) -> None:
        """Pass requests on again; the arguments are those of :meth:`hop_down`."""
        if self._hop_prober is not None:
            self._hop_prober.resume(transport, address)
        self._forwarder.admission.hop_up(transport, address)

    def is_down(self, hop: Endpoint) -> bool:
        """Return whether a hop is known not to answer now."""
        return self._forwarder.admission.is_down(hop)

    def is_awaited(self, hop: Endpoint) -> bool:
        """Return whether an answer from a hop is waited for, or subscriptions come from it."""
        return hop in self._forwarder.notification_forwarder.subscriptions.hops or bool(
            self._forwarder.in_flight.on(*hop)
        )

    def waiting(self, endpoint: Endpoint) -> int:
        """Return the number of requests from *endpoint* that wait for answers."""
        return self._forwarder.in_flight.count(endpoint)

    def notify(self, endpoint: Endpoint, packet: bytes) -> list[Action]:
        """Send a packet of a service to a client; nothing if its transport is gone."""
        return (
            [self._transports.reply(endpoint, packet)]
            if endpoint.transport in self._transports.transports
            else []
        )

    def next_timeout(self) -> int | None:
        """Return when :meth:`handle_timeout` has something to do."""
        times = [self._forwarder.next_timeout(), self._table.next_timeout()]
        if self._hop_prober is not None:
            times.append(self._hop_prober.next_timeout())
        return min((each for each in times if each is not None), default=None)

    def handle_timeout(self, now_ns: int) -> list[Action]:
        """Reply to requests that timed out, forget expired routes, probe hops."""
        self._table.expire(now_ns)
        actions = self._forwarder.handle_timeout(now_ns)
        if self._hop_prober is not None:
            for probe in self._hop_prober.probes_due(now_ns):
                if probe.is_found_dead:
                    text = f"{MISSES} probes without an answer"
                    actions += self._forwarder.hop_lost(*probe.hop, text, now_ns)
                if probe.is_gone:
                    self._gone.append(probe.hop)
                # A route may name a transport that this station does not have.
                if probe.hop.transport in self._transports.transports:
                    actions.append(self._transports.forward(probe.hop, probe.packet, _NO_TICKET))
        return actions

    def pop_gone_hops(self) -> list[Endpoint]:
        """Return the hops that have been dead for so long that nothing is kept for them."""
        gone, self._gone = self._gone, []
        return gone

    @property
    def has_events(self) -> bool:
        """True if there are traces or audit entries to be read."""
        return self.record.has_events or self.access_filter.has_entries

    def settle(self) -> None:
        """Count requests and answers, after the actions for them were carried out."""
        self.record.settle()

    def next_event(self) -> Trace | None:
        """Take the oldest trace of what was not simply answered."""
        return self.record.next_event()

    def find_obstacle(self, route: Route) -> Obstacle | None:
        """Return why nothing can go by *route* now; None if something can."""
        return self._forwarder.admission.find_obstacle(route)

    def report(self, route: Route) -> RouteReport:
        """Return the report of one of the routes."""
        traffic = self.record.routes.get(route.key)
        obstacle = self.find_obstacle(route)
        name = self._table.next_name(route)
        return report_route(route, obstacle, traffic, self._hop_prober, next_name=name)

    def locate(self, header: AmsHeader, endpoint: Endpoint) -> Location:
        """Return the route that a request from *endpoint* would take."""
        may = self.access_filter.may(header, endpoint)
        ports = self._devices.get(header.target)
        if ports is not None:
            text = _no_port(header)
            return Location(True, None, "" if header.target_port in ports else text, may)
        found = self._forwarder.admission.find_route(header, endpoint)
        route, why = (found.route, found.text) if isinstance(found, RoutingError) else (found, "")
        found_route = None if route is None else self.report(route)
        missing = [each for each in self.interruptions() if each.addresses[:6] == header.target]
        number = sum(each.number for each in missing)
        since_ns = min((each.since_ns for each in missing), default=None)
        return Location(False, found_route, why, may, number, since_ns)

    def connections(self) -> list[ConnectionReport]:
        """Return the traffic of all open connections."""
        return [ConnectionReport(*each) for each in self.record.connections.snapshot().items()]

    def interruptions(self) -> list[Interruption]:
        """Return the subscriptions to which nothing comes, by client and server."""
        return self._forwarder.subscription_restorer.interruptions()

    def stats(self) -> Stats:
        """Return the statistics."""
        return Stats(
            in_flight=len(self._forwarder.in_flight),
            subscriptions=len(self._forwarder.notification_forwarder.subscriptions),
            fragment_octets=self._fragments.octets,
            routes=len(self._table),
            counts=dict(self.record.counts),
        )

    def _receive_fragment(
        self, header: AmsHeader, body: bytes, endpoint: Endpoint, now_ns: int, *, is_broadcast: bool
    ) -> list[Action]:
        if header.state_flags & _RESPONSE:
            return []  # ours want no acknowledgement
        packet, acknowledgement = self._fragments.receive(endpoint, header, body, now_ns)
        if packet is None:
            return (
                []
                if acknowledgement is None or is_broadcast
                else [Reply(endpoint, (acknowledgement,))]
            )
        whole, _ = decode_packet(packet)
        # Fragments in fragments could be nested without end.
        if whole.command == _FRAGMENT:
            raise MalformedError("a fragment in fragments", layout="AmsHeader")
        return self._receive_whole(whole, packet, endpoint, now_ns, is_broadcast=is_broadcast)

    def _receive_whole(
        self, header: AmsHeader, data: bytes, endpoint: Endpoint, now_ns: int, *, is_broadcast: bool
    ) -> list[Action]:
        if header.state_flags & _RESPONSE:
            return self._receive_answer(header, data, endpoint, now_ns)
        ports = self._devices.get(header.target)
        # Every station of the segment got it: only its target answers, none forwards it.
        if ports is None and is_broadcast:
            return []
        self.record.add_request(endpoint, len(data), header.source, now_ns)
        if header.command == _NOTIFICATION:
            is_own = ports is not None
            return self._forwarder.forward_notification(
                header, data, endpoint, now_ns, is_own=is_own
            )
        if header.source in self._devices and not self.access_filter.access.is_this_host(endpoint):
            text = f"it comes back to where it began: {header.source} is of this station"
            why = RoutingError(AdsError.TARGET_MACHINE, text, outcome=Outcome.LOOP)
            return self._error_replier.reply_error(header, endpoint, why, now_ns)
        if ports is None:
            return self._forwarder.forward_request(header, data, endpoint, now_ns)
        return self._deliver(header, data, endpoint, ports, now_ns)

    def _receive_answer(
        self, header: AmsHeader, data: bytes, endpoint: Endpoint, now_ns: int
    ) -> list[Action]:
        hop_prober = self._hop_prober
        if hop_prober is None or not hop_prober.is_answer(header):
            return self._forwarder.return_answer(header, data, endpoint, now_ns)
        body = data[AmsHeader.SIZE :]
        hop = hop_prober.receive_answer(header, body, endpoint, now_ns, self._transports.is_from)
        if hop is None:
            return []
        # Requests stay: those sent after the restart are answered.
        return self._forwarder.subscriptions_lost(*hop, "its router was started again", now_ns)

    def _deliver(
        self, header: AmsHeader, data: bytes, endpoint: Endpoint, ports: Container[int], now_ns: int
    ) -> list[Action]:
        if header.target_port not in ports:
            why = RoutingError(AdsError.TARGET_PORT, _no_port(header))
            return self._error_replier.reply_error(header, endpoint, why, now_ns)
        through = self.access_filter.filter_request(header, data, endpoint, now_ns)
        if isinstance(through, RoutingError):
            return self._error_replier.reply_error(header, endpoint, through, now_ns)
        data, authorized = through
        body = data[AmsHeader.SIZE :]
        if authorized is None and self._answer_now is not None and header.wants_answer:
            answer = self._answer_now(header, body, endpoint)
            if answer is not None:
                return self._forwarder.answer_now(header, endpoint, *answer, now_ns)
        if not header.wants_answer:
            if authorized is not None:
                self.access_filter.abandon(authorized)
            return [Deliver(_NO_TICKET, header, body, endpoint)]
        ticket = self._forwarder.wait_for_service(header, data, endpoint, authorized, now_ns)
        return [Deliver(ticket, header, body, endpoint)] if isinstance(ticket, int) else ticket


def _no_port(header: AmsHeader) -> str:
    text = f"nothing has port {header.target_port} of {header.target}"
    if header.target_port in _PLC_PORTS:
        # Default port of clients without a configured one.
        text += ": it is no PLC; the variables of a station are at port 65535 of its EAP ports"
    return text
