"""AMS over MQTT: transport of a station to a network of AMS routers behind a broker."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable
from time import monotonic_ns

from eap.ams.mqtt.network import (
    Action,
    Drop,
    Dropped,
    HopDown,
    HopUp,
    MqttNetwork,
    PacketReceived,
    PeerClosed,
    Publish,
    Subscribe,
)
from eap.ams.spec import MqttSpec
from eap.ams.transport_table import Transport
from eap.net.mqtt import Handlers, MqttLink
from eap.runtime.drop_counters import DropReason
from eap.services.routing.station_router import StationRouter
from eap.services.routing.station_routes import mqtt_transport_name

_REFUSALS = {
    Drop.TOPIC: DropReason.MQTT_TOPIC,
    Drop.BROKEN: DropReason.MQTT_BROKEN,
    Drop.LENGTH: DropReason.AMS_LENGTH,
    Drop.FULL: DropReason.MQTT_FULL,
}

logger = logging.getLogger(__name__)


class MqttTransport:
    """One network of one station; the router gets its packets as they come.

    A client behind a broker is never this host, whatever its source NetID.

    Args:
        spec: The network and its broker.
        router: Router of the station.
        count_dropped: Counts a dropped message.
        learns: Whether announced routers become routes.

    Raises:
        EnvironmentalError: MQTT is not installed.
    """

    def __init__(
        self,
        spec: MqttSpec,
        router: StationRouter,
        count_dropped: Callable[[DropReason], object],
        *,
        learns: bool = True,
    ) -> None:
        self.name = mqtt_transport_name(spec)
        self._router = router
        self._count_dropped = count_dropped
        self._network = MqttNetwork(
            spec, router.net_id, router.name, transport=self.name, table=router.table, learns=learns
        )
        self._link = MqttLink(
            spec,
            spec.client_id or f"eap-{router.net_id}-{spec.network}",
            will=self._network.will,
            handlers=Handlers(self._connected, self._lost, self._receive, self._overrun),
        )
        self._timer: asyncio.TimerHandle | None = None
        self._due_ns: int | None = None
        # Shared: all routers of the network are behind one connection to the broker.
        router.add_transport(Transport(self.name, is_shared=True, is_hub=True), self)
        router.hop_down(self.name, None, "not connected to its broker yet")

    async def serve(self) -> None:
        """Keep the connection until cancelled."""
        try:
            await self._link.run()
        finally:
            if self._timer is not None:
                self._timer.cancel()

    def send(self, connection: str, packets: tuple[bytes, ...]) -> str | None:
        """Send packets to the router with NetID *connection*; return the reason of a failure."""
        for packet in packets:
            if (why := self._link.send(self._network.message_for(connection, packet))) is not None:
                return why
        return None

    def _connected(self) -> None:
        self._router.hop_up(self.name, None)
        self._act(self._network.connected(monotonic_ns()))

    def _lost(self, why: str) -> None:
        self._network.disconnected()
        self._router.hop_down(self.name, None, why)
        self._act(())

    def _receive(self, topic: str, payload: bytes, is_retained: bool) -> None:
        now_ns = monotonic_ns()
        self._act(self._network.receive_message(topic, payload, now_ns, is_retained=is_retained))

    def _overrun(self) -> None:
        self._count_dropped(DropReason.MQTT_FULL)

    def _act(self, actions: Iterable[Action]) -> None:
        for action in actions:
            self._do(action)
        due_ns = self._network.next_timeout()
        # Most messages leave the next due time unchanged.
        if due_ns == self._due_ns:
            return
        self._due_ns = due_ns
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if due_ns is not None:
            wait_s = max(0, due_ns - monotonic_ns()) / 1e9
            self._timer = asyncio.get_running_loop().call_later(wait_s, self._time_out)

    def _do(self, action: Action) -> None:
        if isinstance(action, PacketReceived):
            self._router.receive(action.packet, self.name, action.connection)
        elif isinstance(action, (Publish, Subscribe)):
            if (why := self._link.send(action)) is not None:
                logger.debug("%s: %s", self.name, why)
        elif isinstance(action, HopDown):
            self._router.hop_down(self.name, action.address, action.text)
        elif isinstance(action, HopUp):
            self._router.hop_up(self.name, action.address)
        elif isinstance(action, PeerClosed):
            self._router.connection_closed(self.name, action.connection)
        elif isinstance(action, Dropped):
            self._count_dropped(_REFUSALS[action.reason])
        else:
            logger.warning("%s: %s: %s", self._router.name, self.name, action.text)

    def _time_out(self) -> None:
        self._due_ns = None
        self._act(self._network.handle_timeout(monotonic_ns()))
