"""ADS service behind the NetID of a bus port: the master at port 0xFFFF, slaves at their address.

Rule 1: the operations of a request are done one after the other, and one that cannot be done by the
end of the request's time is answered so: an answer comes before routers and clients give up.
Rule 2: requests do not wait for each other here; turns at a slave's mailbox are the bus client's.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Container
from functools import partial
from itertools import islice
from typing import TypeAlias

from eap.ads.endpoint import AmsAnswer, Endpoint
from eap.ads.notifications import Client
from eap.ads.operation import (
    AdsRefusedError,
    Operation,
    OperationOutcome,
    ReadDeviceInfo,
    ReadState,
)
from eap.codec.ads import AdsError
from eap.codec.ams import DEVICE_PORT
from eap.errors import EapError
from eap.gateway.error_table import ads_result
from eap.ids import NetId
from eap.services.ads.ads_requests import answer_request
from eap.services.ads.master_ads import MasterAds, Send, StateRequests, check_up
from eap.services.ads.slave_ads import SlaveAds
from eap.services.device.master_values import MasterDictionaryProvider
from eap.services.routing.service import LocalRequest
from eap.services.slaves.bus_client import BusClient

ANSWER_S = 4.0
"""How long a request may take; routers give up after 4.5 s, clients after 5 s."""
_IN_HEADER = frozenset((AdsError.HOST_UNREACHABLE, AdsError.TARGET_PORT))
"""Errors of the way to a service, which belong into the AMS header."""
_RESULT_SIZE = 4
_MAX_NAMED = 8

Perform: TypeAlias = Callable[[Operation], Awaitable[OperationOutcome]]


class BusService:
    """The services of one bus port.

    Args:
        bus: Behind the port.
        net_id: Of the port.
        release: Of this software, such as ``0.1.0``.
        send: Sends a notification to a client.
        provider: The dictionary of the master.

    Attributes:
        ports: AMS ports that it answers for; a port without a slave is refused here.
    """

    def __init__(
        self,
        bus: BusClient,
        net_id: NetId,
        release: str,
        send: Send,
        provider: MasterDictionaryProvider,
    ) -> None:
        self.ports: Container[int] = range(1, DEVICE_PORT + 1)
        self._name = bus.name
        self._view = bus.view
        states = StateRequests(bus)
        self._master = MasterAds(bus, net_id, release, send, provider, states)
        self._slaves = SlaveAds(bus, net_id, states)

    async def answer(self, request: LocalRequest) -> AmsAnswer:
        """Do the operations of a request; return its answer."""
        header = request.header
        client = Client(request.came_by, header.source, header.source_port)
        end_s = asyncio.get_running_loop().time() + ANSWER_S
        try:
            perform = await self._performer(header.target_port, client)
        except AdsRefusedError as exc:
            return AmsAnswer(error_code=exc.result, why=exc.why)
        except EapError as exc:
            return AmsAnswer(error_code=ads_result(exc), why=str(exc))
        perform_in_time = partial(_perform_until, end_s, perform)
        answer = await answer_request(header.command, request.body, perform_in_time)
        result = int.from_bytes(answer.data[:_RESULT_SIZE], "little")
        return AmsAnswer(error_code=result, why=answer.why) if result in _IN_HEADER else answer

    def client_gone(self, endpoint: Endpoint) -> None:
        """Forget what belongs to a connection that is closed; files stay open for another one."""
        self._master.client_gone(endpoint)

    async def _performer(self, ams_port: int, client: Client) -> Perform:
        """Return the function that does operations for a port; raise AdsRefusedError for no port.

        A slave that cannot be reached is looked for once more before that is answered.
        """
        bus = await self._view.current()
        if ams_port == DEVICE_PORT:
            return lambda operation: self._master.perform(operation, client)
        slave = bus.slaves.get(ams_port)
        if slave is None or not (bus.is_up and slave.to_slave):
            bus = await self._view.confirm()
            slave = bus.slaves.get(ams_port)
        if slave is None:
            known = ", ".join(map(str, islice(bus.slaves, _MAX_NAMED))) or "none"
            why = f"{self._name} has no slave {ams_port}"
            raise AdsRefusedError(AdsError.TARGET_PORT, f"{why}; known are {known}")
        found = slave

        async def perform(operation: Operation) -> OperationOutcome:
            if not isinstance(operation, ReadState | ReadDeviceInfo):
                check_up(self._name, bus)
            return await self._slaves.perform(found, client, operation)

        return perform


async def _perform_until(end_s: float, perform: Perform, operation: Operation) -> OperationOutcome:
    """Do an operation, or return why it was not done; at the end of its time, that it was not."""
    try:
        async with asyncio.timeout_at(end_s):
            return await perform(operation)
    except TimeoutError:
        return OperationOutcome(AdsError.TIMEOUT, why=f"not done within {ANSWER_S:g} s")
    except AdsRefusedError as exc:
        return OperationOutcome(exc.result, why=exc.why)
    except EapError as exc:
        return OperationOutcome(ads_result(exc), why=str(exc))
