"""A master as ADS shows it: the bus as the engine reported it last, and states that are requested.

Own mapping: the state of the master is the highest one that a slave is in, for that is how far its
bus is; TwinCAT's bit 0x10 beside the state of a slave stands for any reason why it is not where it
belongs, and of the bits of its link only that there is none.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence

from devicebus.wire.alstatus import AlState
from eap.aoe.ads_master import SlaveState
from eap.aoe.ads_operation import WriteControl
from eap.aoe.ads_state import INIT, al_state_for, states_of
from eap.appliance.bus_request import SlaveDescription
from eap.appliance.handover import PortName
from eap.appliance.services.bus.bus_client import BusClient
from eap.codec.ads import AdsStates
from eap.errors import EapError

_ERROR = 0x10
_NO_LINK = 0x01
_ALL = 0

logger = logging.getLogger(__name__)


class MasterSide:
    """The master behind a bus port, for ``MasterSpace`` and ``AdsDevice``.

    Args:
        bus: Asks the engine.
        port: Which bus.
    """

    def __init__(self, bus: BusClient, port: PortName) -> None:
        self._client = bus
        self._view = bus.views[port]
        self._port = port
        self._requests: dict[int, asyncio.Task[None]] = {}

    def state(self) -> int:
        """Return the AL state of the master."""
        bus = self._view.latest
        if not bus.is_up:
            return INIT
        return max((slave.state for slave in bus.slaves.values()), default=0) or INIT

    def states(self) -> AdsStates:
        """Return what ReadState tells."""
        return states_of(self.state())

    def slaves(self) -> Sequence[SlaveState]:
        """Return all slaves, in their order on the bus."""
        return [
            SlaveState(slave.station, _state(slave), 0 if slave.state else _NO_LINK)
            for slave in self._view.latest.slaves.values()
        ]

    def request_state(self, state: int) -> None:
        """Bring all slaves to a state, without waiting."""
        self._request(_ALL, state)

    def request_slave_state(self, address: int, state: int) -> None:
        """Bring one slave to a state, without waiting."""
        self._request(address, state)

    def control(self, request: WriteControl) -> None:
        """Act on a WriteControl."""
        self.request_state(al_state_for(request.ads_state))

    def _request(self, station: int, state: int) -> None:
        """The last request counts: one before it that is not done is given up."""
        if (before := self._requests.pop(station, None)) is not None:
            before.cancel()
        task = asyncio.get_running_loop().create_task(self._bring(station, AlState(state)))
        self._requests[station] = task
        task.add_done_callback(lambda task: self._forget(station, task))

    async def _bring(self, station: int, target: AlState) -> None:
        try:
            await self._client.bring(self._port, station, target)
        except EapError as exc:
            who = f"slave {station}" if station else "all slaves"
            name = f"{self._port.station}/{self._port.port}"
            logger.warning("%s: %s to %s by ADS: %s", name, who, target.name, exc)

    def _forget(self, station: int, task: asyncio.Task[None]) -> None:
        if self._requests.get(station) is task:
            del self._requests[station]


def _state(slave: SlaveDescription) -> int:
    return slave.state | (_ERROR if slave.fault else 0)
