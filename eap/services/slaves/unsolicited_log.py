"""Log of PDOs that slaves send, or request, by mailbox (ETG.1000.6, CoE services 4 to 7).

The master exchanges PDOs by sync managers only.  What a slave sends by mailbox all the same has no
use here, so that a line names it; emergencies and Ethernet frames have receivers of their own.
"""

from __future__ import annotations

import logging

from devicebus.master.mailboxes import Unsolicited
from eap.codec.coe import PDO_SERVICES, CoeHeader, CoeService, describe_message
from eap.codec.mailbox import MailboxType
from eap.services.limited_log import caused_by
from eap.services.slaves.bus_client import BusClient

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
