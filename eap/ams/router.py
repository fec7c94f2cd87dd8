"""The router of a station: AMS packets to its own services and to the next station (ETG.1020).

Every request is answered exactly once, on the connection that it came by: by its target, or with
an error of the AMS header that says why it did not get there.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable
from typing import TypeAlias

from eap.ads.answer import AmsAnswer
from eap.ams.access import AccessList
from eap.ams.access_filter import Gate
from eap.ams.action import Action, Deliver, Outcome, Reply, Trace
from eap.ams.admission import Limits
from eap.ams.endpoint import Door, Way
from eap.ams.error_reply import Refusal, Refuser, wants_answer
from eap.ams.forwarder import Passage
from eap.ams.hop_prober import MISSES, Prober
from eap.ams.reassembly import Reassembly
from eap.ams.record import Record, Stats
from eap.ams.report import ConnectionReport, Location, RouteReport, report_route
from eap.ams.routes import Route, RouteTable
from eap.ams.subscription_restorer import Interruption
from eap.ams.transport_table import Outlet
from eap.codec.ads import AdsError
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags, decode_packet
from eap.errors import CodecError, MalformedError
from eap.ids import NetId

_RESPONSE = StateFlags.RESPONSE.value  # plain numbers: enums and operators of flags are slow
_FRAGMENT = AmsCommand.FRAGMENT.value
_NOTIFICATION = AmsCommand.NOTIFICATION.value
_PLC_PORTS = frozenset((801, 811, 821, 831, *range(851, 860)))
"""Of the runtimes of TwinCAT 2 and 3."""
_NOBODY = 0
"""Ticket of a request that has no answer."""


AnswerNow: TypeAlias = Callable[[AmsHeader, bytes, Way], tuple[AmsAnswer, int] | None]
"""Returns the answer to a request, with its header, body and origin, and how many nanoseconds it
took; None to have the request delivered."""


class Router:
    """What becomes of every packet.

    Args:
        net_id: Of the router itself.
        table: The routes; they may change at any time.
        doors: By which packets come and go.
        first_invoke_id: Another one at each start, see :class:`~eap.ams.invoke.InvokeIds`.
        limits: How much it takes on.
        prober: Finds dead hops; without one only doors tell of them.
        access: Who may do what; without rules others than this host only read.
        answer_now: Answers what a service of this station has at hand: then there is no ``Deliver``
            and nothing waits.

    Attributes:
        record: What it did.
        gate: What it had changed, and what it refused.
    """

    def __init__(
        self,
        net_id: NetId,
        table: RouteTable,
        doors: Iterable[Door],
        *,
        first_invoke_id: int,
        limits: Limits | None = None,
        prober: Prober | None = None,
        access: AccessList | None = None,
        answer_now: AnswerNow | None = None,
    ) -> None:
        self.record = Record()
        self.gate = Gate(access or AccessList(), self.record)
        self._table = table
        self._outlet = Outlet(doors)
        self._refuser = Refuser(self._outlet, self.record)
        self._prober = prober
        self._gone: list[Way] = []
        self._answer_now = answer_now
        self._devices: dict[NetId, Container[int]] = {}
        self._fragments = Reassembly()
        self._passage = Passage(
            net_id, table, self._outlet, self._refuser, self.record, self.gate,
            first_invoke_id=first_invoke_id, limits=limits or Limits(), prober=prober,
        )  # fmt: skip

    def add_device(self, net_id: NetId, ports: Container[int]) -> None:
        """Let services answer for *net_id*; *ports* says at any time which AMS ports it has."""
        self._devices[net_id] = ports

    def add_door(self, door: Door) -> None:
        """Let packets come and go by *door*; raises ValueError as :meth:`Outlet.add`."""
        self._outlet.add(door)

    def remove_door(self, name: str, now_ns: int) -> list[Action]:
        """Forget a door, and whoever waits at it; answer what waits for those behind it."""
        actions: list[Action] = []
        for way in self._passage.ways_of(name):
            actions += self.connection_closed(*way, now_ns)
        actions += self._passage.hop_lost(name, None, f"{name} is there no more", now_ns)
        self._passage.door_removed(name)
        self._outlet.remove(name)
        return actions

    def hop_is_at(self, door: str, address: str, connection: str) -> None:
        """Take what comes by *connection* for what comes from the hop that is named *address*."""
        self._outlet.note_place(Way(door, address), connection)

    def is_waiting_for(self, header: AmsHeader, body: bytes, door: str) -> bool:
        """Say whether a client of this router waits for a packet: for the answer or the sample.

        This serves those that have several routers behind one socket.  The target does not say it:
        clients may have the NetID of any router.
        """
        if header.state_flags & _RESPONSE:
            pending = self._passage.in_flight.get(header.invoke_id)
            return (
                pending is not None
                and pending.route is not None
                and (pending.route.hop.door == door)
            )
        is_notification = header.command == _NOTIFICATION
        return is_notification and self._passage.notifier.knows(header, body)

    def receive_packet(
        self, data: bytes, door: str, connection: str, now_ns: int, *, for_all: bool = False
    ) -> list[Action]:
        """Act on a packet, or on the fragment of one; nothing that a peer sends raises.

        Args:
            data: Header and what follows it.
            door: That it came by.
            connection: That it came by, or its sender's address.
            now_ns: The time on the monotonic clock.
            for_all: Whether others got it too: who is not meant says nothing.
        """
        way = Way(door, connection)
        try:
            header = AmsHeader.decode(data)
            end = AmsHeader.SIZE + header.length
            if header.command == _FRAGMENT or len(data) != end:
                _, body = decode_packet(data)
                if header.command == _FRAGMENT:
                    return self._receive_fragment(header, bytes(body), way, now_ns, for_all=for_all)
                data = data[:end]
            return self._receive_whole(header, data, way, now_ns, for_all=for_all)
        except CodecError as exc:
            return self._refuser.drop(way, None, Outcome.DROPPED, str(exc), now_ns)

    def receive_answer(self, ticket: int, answer: AmsAnswer, now_ns: int) -> list[Action]:
        """Send back what a service of this station says to the request with *ticket*.

        What comes after its time, or after its connection was closed, is dropped.
        """
        return self._passage.answer(ticket, answer, now_ns)

    def send_failed(self, ticket: int, text: str, now_ns: int) -> list[Action]:
        """Answer the request with *ticket*, which its door could not send; *text* says why."""
        return self._passage.send_failed(ticket, text, now_ns)

    def connection_closed(self, door: str, connection: str, now_ns: int) -> list[Action]:
        """Forget whom nobody can answer any more, and end the notifications that they had."""
        way = Way(door, connection)
        self._fragments.forget(way)
        self.record.connections.forget(way)
        return self._passage.connection_closed(way, now_ns)

    def hop_down(self, door: str, address: str | None, text: str, now_ns: int) -> list[Action]:
        """Answer what waits for *address*, and what will be for it, with "host unreachable".

        Args:
            door: By which it is reached.
            address: None for all that are reached by the door.
            text: Why, for people.
            now_ns: The time on the monotonic clock.
        """
        if self._prober is not None:
            self._prober.pause(door, address)
        return self._passage.hop_down(door, address, text, now_ns)

    def hop_up(self, door: str, address: str | None) -> None:
        """Pass requests on again; the arguments are those of :meth:`hop_down`."""
        if self._prober is not None:
            self._prober.resume(door, address)
        self._passage.hop_up(door, address)

    def is_down(self, hop: Way) -> bool:
        """Say whether a hop is known not to answer now."""
        return self._passage.is_down(hop)

    def is_awaited(self, hop: Way) -> bool:
        """Say whether an answer from a hop is waited for, or subscriptions come from it."""
        return hop in self._passage.notifier.subscriptions.hops or bool(
            self._passage.in_flight.on(*hop)
        )

    def waiting(self, way: Way) -> int:
        """Return how many requests that came by *way* wait for their answers."""
        return self._passage.in_flight.count(way)

    def notify(self, way: Way, packet: bytes) -> list[Action]:
        """Send what a service has for a client; nothing if its door is there no more."""
        return [self._outlet.reply(way, packet)] if way.door in self._outlet.doors else []

    def next_timeout(self) -> int | None:
        """Return when :meth:`handle_timeout` has something to do."""
        times = [self._passage.next_timeout(), self._table.next_timeout()]
        if self._prober is not None:
            times.append(self._prober.next_timeout())
        return min((each for each in times if each is not None), default=None)

    def handle_timeout(self, now_ns: int) -> list[Action]:
        """Answer requests whose time is up, forget routes that expired, ask hops for life."""
        self._table.expire(now_ns)
        actions = self._passage.handle_timeout(now_ns)
        if self._prober is not None:
            for probe in self._prober.probes_due(now_ns):
                if probe.is_found_dead:
                    text = f"{MISSES} probes without an answer"
                    actions += self._passage.hop_lost(*probe.hop, text, now_ns)
                if probe.is_gone:
                    self._gone.append(probe.hop)
                if probe.hop.door in self._outlet.doors:
                    actions.append(self._outlet.forward(probe.hop, probe.packet, _NOBODY))
        return actions

    def take_gone_hops(self) -> list[Way]:
        """Return the hops that have been dead for so long that nothing is kept for them."""
        gone, self._gone = self._gone, []
        return gone

    @property
    def has_news(self) -> bool:
        """Whether there are traces or entries of the audit to be taken."""
        return self.record.has_events or self.gate.has_entries

    def next_event(self) -> Trace | None:
        """Take the oldest trace of what was not simply answered."""
        return self.record.next_event()

    def report(self, route: Route) -> RouteReport:
        """Return what is known of one of the routes."""
        traffic = self.record.routes.get(route.key)
        obstacle = self._passage.find_obstacle(route)
        name = self._table.next_name(route)
        return report_route(route, obstacle, traffic, self._prober, next_name=name)

    def locate(self, header: AmsHeader, way: Way) -> Location:
        """Say where a request would go that came by *way*."""
        may = self.gate.may(header, way)
        ports = self._devices.get(header.target)
        if ports is not None:
            text = _no_port(header)
            return Location(True, None, "" if header.target_port in ports else text, may)
        found = self._passage.find_route(header, way)
        route, why = (found.route, found.text) if isinstance(found, Refusal) else (found, "")
        found_route = None if route is None else self.report(route)
        missing = [each for each in self.interruptions() if each.asked[:6] == header.target]
        number = sum(each.number for each in missing)
        since_ns = min((each.since_ns for each in missing), default=None)
        return Location(False, found_route, why, may, number, since_ns)

    def connections(self) -> list[ConnectionReport]:
        """Return who asks, or asked and is still connected."""
        return [ConnectionReport(*each) for each in self.record.connections.snapshot().items()]

    def interruptions(self) -> list[Interruption]:
        """Return the subscriptions to which nothing comes, by client and server."""
        return self._passage.restorer.interruptions()

    def stats(self) -> Stats:
        """Return what is going on, and what was."""
        return Stats(
            in_flight=len(self._passage.in_flight),
            subscriptions=len(self._passage.notifier.subscriptions),
            fragment_octets=self._fragments.octets,
            routes=len(self._table),
            counts=dict(self.record.counts),
        )

    def _receive_fragment(
        self, header: AmsHeader, body: bytes, way: Way, now_ns: int, *, for_all: bool
    ) -> list[Action]:
        if header.state_flags & _RESPONSE:
            return []  # ours want no acknowledgement
        packet, acknowledgement = self._fragments.receive(way, header, body, now_ns)
        if packet is None:
            return [] if acknowledgement is None or for_all else [Reply(way, (acknowledgement,))]
        whole, _ = decode_packet(packet)
        if whole.command == _FRAGMENT:
            raise MalformedError("a fragment in fragments", layout="AmsHeader")
        return self._receive_whole(whole, packet, way, now_ns, for_all=for_all)

    def _receive_whole(
        self, header: AmsHeader, data: bytes, way: Way, now_ns: int, *, for_all: bool
    ) -> list[Action]:
        if header.state_flags & _RESPONSE:
            return self._receive_answer(header, data, way, now_ns)
        ports = self._devices.get(header.target)
        if ports is None and for_all:
            return []
        self.record.connections.of(way, now_ns).ask(len(data), header.source)
        if header.command == _NOTIFICATION:
            is_own = ports is not None
            return self._passage.take_notification(header, data, way, now_ns, is_own=is_own)
        if header.source in self._devices and not self.gate.is_this_host(way):
            text = f"it comes back to where it began: {header.source} is of this station"
            why = Refusal(AdsError.TARGET_MACHINE, text, outcome=Outcome.LOOP)
            return self._refuser.refuse(header, way, why, now_ns)
        if ports is None:
            return self._passage.take_request(header, data, way, now_ns)
        return self._deliver(header, data, way, ports, now_ns)

    def _receive_answer(
        self, header: AmsHeader, data: bytes, way: Way, now_ns: int
    ) -> list[Action]:
        prober = self._prober
        if prober is None or not prober.is_answer(header):
            return self._passage.take_answer(header, data, way, now_ns)
        body = data[AmsHeader.SIZE :]
        hop = prober.take_answer(header, body, way, now_ns, self._outlet.is_from)
        if hop is None:
            return []
        # Requests stay: those that were asked since then are answered.
        return self._passage.subscriptions_lost(*hop, "its router was started again", now_ns)

    def _deliver(
        self, header: AmsHeader, data: bytes, way: Way, ports: Container[int], now_ns: int
    ) -> list[Action]:
        if header.target_port not in ports:
            why = Refusal(AdsError.TARGET_PORT, _no_port(header))
            return self._refuser.refuse(header, way, why, now_ns)
        through = self.gate.let_through(header, data, way, now_ns)
        if isinstance(through, Refusal):
            return self._refuser.refuse(header, way, through, now_ns)
        data, judged = through
        body = data[AmsHeader.SIZE :]
        if judged is None and self._answer_now is not None and wants_answer(header):
            answer = self._answer_now(header, body, way)
            if answer is not None:
                return self._passage.answer_now(header, way, *answer, now_ns)
        if not wants_answer(header):
            if judged is not None:
                self.gate.give_up(judged)
            return [Deliver(_NOBODY, header, body, way)]
        ticket = self._passage.wait_for_service(header, data, way, judged, now_ns)
        return [Deliver(ticket, header, body, way)] if isinstance(ticket, int) else ticket


def _no_port(header: AmsHeader) -> str:
    text = f"nothing has port {header.target_port} of {header.target}"
    if header.target_port in _PLC_PORTS:
        # Where clients look that were told of no port.
        text += ": it is no PLC; the variables of a station are at port 65535 of its EAP ports"
    return text
