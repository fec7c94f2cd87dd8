"""Requests for slaves that have ADS services themselves, passed to them by AoE (ETG.1020).

A slave is told the NetID of its bus port and its station address as its own address before the
first request, and again when it says that it is somebody else: one that was started anew has
forgotten it.
"""

from __future__ import annotations

from itertools import count

from devicebus.mailbox import aoe_client
from eap.aoe.ads_operation import Operation, OperationOutcome, Write
from eap.aoe.ads_query import decode_outcome, encode_query
from eap.appliance.handover import PortName
from eap.appliance.services.bus.bus_client import BusClient
from eap.appliance.services.bus_ads.slave_space import Asked
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import AmsHeader
from eap.ids import NetId

_NET_ID_OFFSET = 3
_IS_SOMEBODY_ELSE = frozenset((AdsError.TARGET_MACHINE, AdsError.TARGET_PORT))


class Passthrough:
    """AoE to the slaves of one bus.

    Args:
        bus: Talks to the slaves.
        port: Where they are.
        net_id: Of the bus port.
    """

    def __init__(self, bus: BusClient, port: PortName, net_id: NetId) -> None:
        self._bus = bus
        self._port = port
        self._net_id = net_id
        self._told: set[int] = set()
        self._numbers = count(1)

    async def perform(self, asked: Asked, operation: Operation) -> OperationOutcome:
        """Have the slave do an operation; return how it came out.

        Raises:
            EapError: the slave does not answer, or as ``results.refusal`` knows.
        """
        client = asked.client
        source = client.net_id, client.port
        station = asked.slave.station
        if station not in self._told:
            await self._tell_address(asked)
            self._told.add(station)
        outcome = await self._exchange(asked, operation, source)
        if outcome.result in _IS_SOMEBODY_ELSE:
            await self._tell_address(asked)
            outcome = await self._exchange(asked, operation, source)
        return outcome

    async def _tell_address(self, asked: Asked) -> None:
        """Tell a slave who it is; one that does not want to know is none the worse."""
        told = Write(IndexGroup.ADDRESS, _NET_ID_OFFSET, bytes(self._net_id))
        await self._exchange(asked, told, (self._net_id, asked.slave.station))

    async def _exchange(
        self, asked: Asked, operation: Operation, source: tuple[NetId, int]
    ) -> OperationOutcome:
        command, body = encode_query(operation)
        station = asked.slave.station
        # Clients have the same ids, and an answer that came too late is known by its own.
        number = next(self._numbers) & 0xFFFF_FFFF
        header = AmsHeader(
            self._net_id, station, *source, command, length=len(body), invoke_id=number
        )
        talk = aoe_client.exchange(header, body, asked.sizes)
        answer, data = await self._bus.converse(self._port, station, talk, asked.client)
        return decode_outcome(command, answer.error_code, data)
