"""What slaves say of themselves in objects that a master's dictionary repeats (ETG.1510).

A slave is asked once, by its mailbox, when somebody looks; whatever it does not answer soon is
unknown until it comes back after it was gone.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from contextlib import suppress
from typing import NamedTuple

from devicebus.mailbox import coe_client
from devicebus.mailbox.conversation import Conversation
from devicebus.wire.sii import SiiProtocol
from eap.appliance.bus_request import SlaveReport
from eap.appliance.handover import PortName
from eap.appliance.services.bus.bus_client import BusClient
from eap.errors import EapError
from eap.od.abort import SdoAbortError

_ANSWER_S = 0.3
"""How long a client of the dictionary waits for it."""
_DEVICE_TYPE, _HISTORY = 0x1000, 0x10F3


class Facts(NamedTuple):
    """What one slave says."""

    device_type: int = 0
    has_history: bool = False


class SlaveFacts:
    """What the slaves of one bus say.

    Args:
        bus: Reaches them.
        port: Which bus.
    """

    def __init__(self, bus: BusClient, port: PortName) -> None:
        self._bus = bus
        self._port = port
        self._facts: dict[int, Facts] = {}

    def of(self, station: int) -> Facts:
        """Return what is known of a slave."""
        return self._facts.get(station, Facts())

    def is_known(self, slave: SlaveReport) -> bool:
        """Say whether :meth:`ask` has nothing to do."""
        has_coe = bool(slave.to_slave and slave.protocols & SiiProtocol.COE)
        return slave.station in self._facts or not has_coe

    async def ask(self, slave: SlaveReport) -> None:
        """Ask a slave that has not been asked yet."""
        if self.is_known(slave):
            return
        facts = Facts()
        with suppress(EapError, TimeoutError):
            async with asyncio.timeout(_ANSWER_S):
                facts = await self._bus.converse(
                    self._port, slave.station, _inquire(), requester="dictionary of the master"
                )
        self._facts[slave.station] = facts

    def forget(self, stations: Iterable[int]) -> None:
        """Ask slaves anew: there may be others in their place."""
        for station in stations:
            self._facts.pop(station, None)


def _inquire() -> Conversation[Facts]:
    device_type = yield from coe_client.upload(_DEVICE_TYPE, 0)
    try:
        yield from coe_client.upload(_HISTORY, 0)
        has_history = True
    except SdoAbortError:
        has_history = False
    return Facts(int.from_bytes(device_type, "little"), has_history)
