"""A router with the transports of a station, for tests: packets in, packets out."""

from __future__ import annotations

from collections.abc import Iterable

from eap.ams.access import AccessList
from eap.ams.hop_prober import HopProber
from eap.ams.inflight import RouterLimits
from eap.ams.record import Outcome
from eap.ams.router import AnswerNow, Router
from eap.ams.routes import Route, RouteTable
from eap.ams.spec import AccessRule
from eap.ams.transport_table import Action, Deliver, Forward, Reply, Transport
from eap.ids import Endpoint, NetId
from tests.support.ams import Ams, parse

ROUTER = "5.1.1.1.1.1"
DEVICE = "5.1.1.1.2.1:65535"
CLIENT = "192.168.0.9.1.1:30000"
FAR = "6.1.1.1.1.1"
FAR_DEVICE = f"{FAR}:851"
LINK = Endpoint("link", "10.0.0.6")
SECOND_LINK = Endpoint("link", "10.0.0.7")
TRANSPORTS = (
    Transport("tcp", is_stream=True, is_hub=True),
    Transport("local", is_stream=True, is_hub=True),
    Transport("link", is_hub=True, is_stream=True),
    Transport("segment"),
    Transport("broker", is_shared=True),
    Transport("narrow", max_size=60),
)

ANYTHING = AccessRule("anything")


def route(net_id: str, hop: Endpoint, name: str = "", **more: object) -> Route:
    return Route(NetId.parse(net_id), name or f"to {net_id}", hop, **more)


class Station:
    """A router; what it wants done is taken apart."""

    def __init__(self, routes: Iterable[Route] = (), *, first_id: int = 1000,
                 limits: RouterLimits | None = None, is_probing: bool = False,
                 rules: Iterable[AccessRule] = (ANYTHING,),
                 answer_now: AnswerNow | None = None) -> None:  # fmt: skip
        self.table = RouteTable([*routes])
        net_id = NetId.parse(ROUTER)
        hop_prober = HopProber(net_id, self.table) if is_probing else None
        self.router = Router(
            net_id, self.table, TRANSPORTS, first_invoke_id=first_id, limits=limits,
            hop_prober=hop_prober,
            access=AccessList([*rules]), answer_now=answer_now,
        )  # fmt: skip
        self.router.add_device(NetId.parse(ROUTER), {10000})
        self.router.add_device(NetId.parse("5.1.1.1.2.1"), {65535})
        self.now_ns = 0

    def give(self, packet: Ams, endpoint: Endpoint, **more: bool) -> list[Action]:
        return self.router.receive_packet(
            packet.octets(), endpoint.transport, endpoint.connection, self.now_ns, **more
        )

    def forwarded(self, packet: Ams, endpoint: Endpoint) -> Ams:
        """Give a request that goes on; return what the hop gets."""
        (action,) = self.give(packet, endpoint)
        assert isinstance(action, Forward), action
        return parse(*action.packets)

    def delivered(self, packet: Ams, endpoint: Endpoint) -> Deliver:
        """Give a request for a service; return what that gets."""
        (action,) = self.give(packet, endpoint)
        assert isinstance(action, Deliver), action
        return action

    def replied(self, packet: Ams, endpoint: Endpoint) -> tuple[Endpoint, Ams]:
        """Give a packet that something goes back for; return where, and what."""
        return only_reply(self.give(packet, endpoint))

    def events(self) -> list[tuple[Outcome, str]]:
        return [(each.outcome, each.text) for each in iter(self.router.next_event, None)]


def only_reply(actions: list[Action]) -> tuple[Endpoint, Ams]:
    (action,) = actions
    assert isinstance(action, Reply), action
    return action.endpoint, parse(*action.packets)
