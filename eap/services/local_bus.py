"""One bus port in services: client, dictionary, gateway, ADS, EoE and simulated slaves.

The master exchanges PDOs by sync managers only.  What a slave sends by mailbox all the same
(ETG.1000.6, CoE services 4 to 7) has no use here, so that a line names it; emergencies and Ethernet
frames have receivers of their own.
"""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable

from devicebus.master.mailboxes import Unsolicited
from eap.codec.coe import PDO_SERVICES, CoeHeader, CoeService, describe_message
from eap.codec.mailbox import MailboxType
from eap.pd.spec import GatewaySpec, PortSpec
from eap.release import RELEASE
from eap.runtime.handover import NO_DESCRIPTOR, BusSocket
from eap.services.ads.bus_ads import BusService
from eap.services.ads.slave_notifications import SamplingBudget
from eap.services.device.master_values import MasterDictionaryProvider
from eap.services.engine_link import EngineLink
from eap.services.gateway.gateway import MailboxGateway
from eap.services.gateway.opening import follow_settings, open_gateway
from eap.services.limited_log import caused_by
from eap.services.routing.station_router import StationRouter
from eap.services.slaves.bus_client import BusClient
from eap.services.slaves.segment_link import SegmentLink
from eap.services.tasks import TaskSet, keep_serving


class LocalBus:
    """All services of one bus port, from their opening to :meth:`close`.

    Args:
        link: To the engine.
        bus: Number and descriptors of the bus.
        port: The bus port.
        router: Of its station.
        budget: Limits of notifications on values of slaves, shared by all buses.
        on_gateway: Called with the gateway before it takes requests.

    Attributes:
        bus: As given.
        client: Of the bus.
        gateway: Mailbox gateway to it.
        segment: Takes commands for simulated slaves, None for others.
    """

    def __init__(
        self,
        link: EngineLink,
        bus: BusSocket,
        port: PortSpec,
        router: StationRouter,
        budget: SamplingBudget,
        on_gateway: Callable[[MailboxGateway], None],
    ) -> None:
        self.bus = bus
        self.client = BusClient(link, bus.number, bus.owner)
        self._port = port
        self._router = router
        self._tasks = TaskSet(f"bus {self.client.name}")
        log_unsolicited_pdos(self.client)
        spec = port.gateway or GatewaySpec()
        provider = MasterDictionaryProvider(
            self.client, RELEASE, full=spec.full, padded=spec.padded
        )
        self._provider = provider
        self.gateway = open_gateway(self.client, port, provider, router)
        on_gateway(self.gateway)
        self._service = BusService(
            self.client, port.net_id, RELEASE, router.send_notification, provider, budget
        )
        router.add_net_id(port.net_id)
        router.add_service(port.net_id, self._service)
        router.add_fault_finder(port.net_id, self.client.find_faults)
        self.segment: SegmentLink | None = None
        if bus.command_fd != NO_DESCRIPTOR:
            self.segment = SegmentLink(socket.socket(fileno=bus.command_fd))
        if port.eoe is not None:
            # Imported here: few plants use EoE.
            from eap.services.slaves.eoe_bridge import EoeBridge

            bridge = EoeBridge(self.client, port.eoe)
            self.client.report_eoe = bridge.report
            self._tasks.start(keep_serving(bridge.serve))

    def follow(self, port: PortSpec) -> None:
        """Apply other settings of the gateway."""
        follow_settings(self.gateway, self._port.gateway or GatewaySpec(), port, self._tasks)
        self._port = port

    async def close(self) -> None:
        """Take no requests any more; those under way fail."""
        self._router.remove_net_id(self._port.net_id)
        self.client.close()
        if self.segment is not None:
            self.segment.close()
        await self._tasks.close()
        await self.gateway.stop()
        await self._service.close()
        await self._provider.close()


_REASONS = {
    CoeService.TX_PDO: "not used: inputs are taken from its sync manager",
    CoeService.RX_PDO: "not used: an RxPDO goes from the master to the slave",
    CoeService.TX_PDO_REMOTE_REQUEST: "not answered: a TxPDO goes from the slave to the master",
    CoeService.RX_PDO_REMOTE_REQUEST: "not answered: outputs are written to its sync manager",
}

logger = logging.getLogger(__name__)


def log_unsolicited_pdos(bus: BusClient) -> None:
    """Log each PDO and remote request that a slave of *bus* sends by mailbox."""

    def take(message: Unsolicited) -> None:
        if message.type is not MailboxType.COE or len(message.data) < CoeHeader.SIZE:
            return
        service = message.data[1] >> 4
        if service not in PDO_SERVICES:
            return
        slave = bus.view.latest.slaves.get(message.station)
        name = f"{bus.name}/{slave.name}" if slave is not None else bus.name
        text = describe_message(message.data)
        logger.warning(
            "%s: slave %d sends by mailbox: CoE %s (%d bytes), %s",
            name, message.station, text, len(message.data) - CoeHeader.SIZE,
            _REASONS[CoeService(service)],
            extra=caused_by((bus.name, message.station, text), bus.name),
        )  # fmt: skip

    bus.listen(take)
