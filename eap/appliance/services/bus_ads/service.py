"""Whoever answers behind the NetID of a bus port: the master at port 0xFFFF, slaves at theirs.

Rule 1: the operations of a request are done one after the other, and what cannot be done by the end
of its time is answered so: an answer comes before the routers on its way lose patience, and clients
theirs.
Rule 2: requests do not wait for each other here; turns at a slave's mailbox are the bus client's.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Container
from functools import partial
from itertools import islice
from time import monotonic_ns
from typing import TypeAlias

from eap.aoe.access import place_of
from eap.aoe.ads_device import AdsDevice
from eap.aoe.ads_master import MasterSpace
from eap.aoe.ads_notifications import Client
from eap.aoe.ads_objects import ObjectSpace
from eap.aoe.ads_operation import (
    AdsRefusedError,
    Operation,
    OperationOutcome,
    ReadDeviceInfo,
    ReadState,
    ReadWrite,
)
from eap.aoe.answer import AmsAnswer
from eap.aoe.way import Way
from eap.appliance.handover import PortName
from eap.appliance.services.ads.ads_requests import answer_request
from eap.appliance.services.ads.eap_ads import device_info
from eap.appliance.services.bus.bus_client import BusClient
from eap.appliance.services.bus_ads.master_side import MasterSide
from eap.appliance.services.bus_ads.master_watch import MasterWatch, Send
from eap.appliance.services.bus_ads.raw_command import RawCommands
from eap.appliance.services.bus_ads.results import refusal
from eap.appliance.services.bus_ads.slave_space import Asked
from eap.appliance.services.bus_ads.slaves import Slaves
from eap.appliance.services.master.master_desk import MasterDesk
from eap.appliance.services.routing.service import LocalRequest
from eap.appliance.services.slaves.bus_view import BusDescription
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.adsnotification import AddNotification
from eap.codec.ams import DEVICE_PORT
from eap.errors import EapError
from eap.gateway.error_table import ads_result
from eap.ids import NetId
from eap.od.model import OdState

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
        bus: Reaches the bus through the engine.
        port: Which bus.
        net_id: Of the port.
        release: Of this software, such as ``0.1.0``.
        send: Sends a notification to a client.
        desk: The dictionary of the master.

    Attributes:
        ports: AMS ports that it answers for; it knows itself which slaves there are.
    """

    def __init__(
        self,
        bus: BusClient,
        port: PortName,
        net_id: NetId,
        release: str,
        send: Send,
        desk: MasterDesk,
    ) -> None:
        self.ports: Container[int] = range(1, DEVICE_PORT + 1)
        self._bus = bus
        self._view = bus.views[port]
        self._port = port
        self._desk = desk
        self._watched: set[int] = set()  # objects that somebody was ever told of
        self._master = MasterSide(bus, port)
        self._slaves = Slaves(bus, port, net_id, self._master)
        self._device = AdsDevice(
            device_info(_name(port), release),
            self._master.states,
            [
                MasterSpace(self._master),
                ObjectSpace(desk.dictionary, lambda: OdState.OP, ads_result),
            ],
            control=self._master.control,
        )
        notifications = self._device.notifications
        self._watch = MasterWatch(notifications, self._look, send, net_id, DEVICE_PORT)

    async def answer(self, request: LocalRequest) -> AmsAnswer:
        """Do what a request asks for."""
        header = request.header
        client = Client(request.came_by, header.source, header.source_port)
        end_s = asyncio.get_running_loop().time() + ANSWER_S
        try:
            perform = await self._performer(header.target_port, client)
        except AdsRefusedError as exc:
            return AmsAnswer(error_code=exc.result, why=exc.why)
        except EapError as exc:
            return AmsAnswer(error_code=refusal(exc).result, why=str(exc))
        perform_in_time = partial(_perform_until, end_s, perform)
        answer = await answer_request(header.command, request.body, perform_in_time)
        result = int.from_bytes(answer.data[:_RESULT_SIZE], "little")
        return AmsAnswer(error_code=result, why=answer.why) if result in _IN_HEADER else answer

    def client_gone(self, way: Way) -> None:
        """Forget what belongs to a connection that is closed; files stay open for another one."""
        self._device.notifications.forget(way)

    async def _look(self) -> None:
        await self._view.confirm()
        for index in self._watched:
            await self._desk.refresh(index)

    async def _performer(self, ams_port: int, client: Client) -> Perform:
        """Return the function that does operations for a port; raise AdsRefusedError for no port.

        A slave that cannot be reached is looked for once more before that is answered.
        """
        bus = await self._view.current()
        if ams_port == DEVICE_PORT:
            return lambda operation: self._perform_of_master(operation, bus, client)
        slave = bus.slaves.get(ams_port)
        if slave is None or not (bus.is_up and slave.to_slave):
            bus = await self._view.confirm()
            slave = bus.slaves.get(ams_port)
        if slave is None:
            known = ", ".join(map(str, islice(bus.slaves, _MAX_NAMED))) or "none"
            why = f"{_name(self._port)} has no slave {ams_port}; known are {known}"
            raise AdsRefusedError(AdsError.TARGET_PORT, why)
        asked = Asked(slave, client)
        return lambda operation: self._perform_of_slave(operation, bus, asked)

    async def _perform_of_master(
        self, operation: Operation, bus: BusDescription, client: Client
    ) -> OperationOutcome:
        if isinstance(operation, ReadWrite) and operation.group == IndexGroup.RAW_COMMAND:
            commands = RawCommands(operation.data)
            _check_up(self._port, bus)
            answer = commands.encode_answer(
                await self._bus.transfer(self._port, commands.accesses())
            )
            if len(answer) > operation.length:
                raise AdsRefusedError(AdsError.SIZE)
            return OperationOutcome(data=answer)
        group, offset = place_of(operation)
        is_object = group in ObjectSpace.groups
        if is_object:
            await self._desk.refresh(offset >> 16)
        outcome = self._device.perform(operation, client, monotonic_ns())
        if is_object and isinstance(operation, AddNotification) and not outcome.result:
            self._watched.add(offset >> 16)
        return outcome

    async def _perform_of_slave(
        self, operation: Operation, bus: BusDescription, asked: Asked
    ) -> OperationOutcome:
        if not isinstance(operation, ReadState | ReadDeviceInfo):
            _check_up(self._port, bus)
        return await self._slaves.perform(asked, operation)


async def _perform_until(end_s: float, perform: Perform, operation: Operation) -> OperationOutcome:
    """Do an operation, or say why it was not done; at the end of its time, that it was not."""
    try:
        async with asyncio.timeout_at(end_s):
            return await perform(operation)
    except TimeoutError:
        return OperationOutcome(AdsError.TIMEOUT, why=f"not done within {ANSWER_S:g} s")
    except AdsRefusedError as exc:
        return OperationOutcome(exc.result, why=exc.why)
    except EapError as exc:
        error = refusal(exc)
        return OperationOutcome(error.result, why=error.why)


def _check_up(port: PortName, bus: BusDescription) -> None:
    if not bus.is_up:
        fault = bus.fault or "it begins"
        raise AdsRefusedError(AdsError.HOST_UNREACHABLE, f"{_name(port)} is not up: {fault}")


def _name(port: PortName) -> str:
    return f"{port.station}/{port.port}"
