"""Execution of ADS requests, and the base of the ADS services of a station.

The operations of a sum command are executed one after the other.  An operation that does not wait
is answered without a task.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping, Sequence
from functools import partial
from secrets import randbelow
from time import monotonic_ns
from typing import TypeAlias

from eap.ads.device import AdsDevice
from eap.ads.notifications import AdsClient, NotificationTable
from eap.ads.request import (
    AdsRefusedError,
    Operation,
    OperationOutcome,
    Outcomes,
    WriteControl,
    accept_request,
    encode_outcome,
)
from eap.ads.space import AdsSpace, al_state_for, states_of
from eap.codec.ads import AdsDeviceInfo, AdsError, AdsStates, device_name
from eap.codec.ams import AmsAnswer
from eap.errors import ControlError
from eap.ids import Endpoint
from eap.services.device.station_device import StationDevice
from eap.services.routing.service import LocalRequest
from eap.services.slaves.bus_client import BusDescription

_AT_ONCE = 64
"""Operations of a sum command after which others have a turn."""

Perform: TypeAlias = Callable[[Operation], OperationOutcome | Awaitable[OperationOutcome]]
"""Does one operation, at once or by the end of what it returns."""


def begin_answer(command: int, body: bytes, perform: Perform) -> AmsAnswer | Awaitable[AmsAnswer]:
    """Execute the operations of a request by *perform*; return the answer, or an awaitable of it.

    Args:
        command: Of the AMS header.
        body: What follows the header.
        perform: Does one operation.
    """
    request = accept_request(command, body)
    if isinstance(request, AmsAnswer):
        return request
    if request.sum_group:
        return _perform_all(Outcomes(request), request.operations, perform)
    outcome = perform(request.operations[0])
    # An operation that is done already needs no task.
    if isinstance(outcome, OperationOutcome):
        return _encode(command, outcome)
    return _finish(command, outcome)


async def answer_request(command: int, body: bytes, perform: Perform) -> AmsAnswer:
    """Return the answer to a request; the arguments are those of :func:`begin_answer`."""
    answer = begin_answer(command, body, perform)
    return answer if isinstance(answer, AmsAnswer) else await answer


async def _finish(command: int, outcome: Awaitable[OperationOutcome]) -> AmsAnswer:
    return _encode(command, await outcome)


def _encode(command: int, outcome: OperationOutcome) -> AmsAnswer:
    return AmsAnswer(encode_outcome(command, outcome), why=outcome.why)


async def _perform_all(
    outcomes: Outcomes, operations: Sequence[Operation], perform: Perform
) -> AmsAnswer:
    for number, operation in enumerate(operations, start=1):
        outcome = perform(operation)
        outcomes.add(outcome if isinstance(outcome, OperationOutcome) else await outcome)
        # A sum command may have hundreds of operations; other clients are served in between.
        if not number % _AT_ONCE:
            await asyncio.sleep(0)
    return outcomes.answer()


async def control_state(device: StationDevice, request: WriteControl) -> OperationOutcome:
    """Execute a WriteControl: bring *device* to a state; the outcome has the reason of an error."""
    try:
        fault = (await device.request_state(al_state_for(request.ads_state))).fault
    except AdsRefusedError as exc:
        return OperationOutcome(
            exc.result, why=f"no state belongs to ADS state {request.ads_state}"
        )
    except ControlError as exc:
        return OperationOutcome(AdsError.BUSY, why=str(exc))
    return OperationOutcome() if fault is None else OperationOutcome(AdsError.STATE, why=fault.text)


def first_handle() -> int:
    """Return a handle to begin with: another one at each start, see ``NotificationTable``."""
    # A client that keeps a handle over a restart must not reach another notification with it.
    return randbelow(1 << 31) + 1


class AdsService:
    """ADS services at some AMS ports of one NetID (Service).

    Args:
        device: The EAP device of the station, whose state is that of the whole.
        info: What ReadDeviceInfo tells.
        spaces: By AMS port: what reads and writes there.

    Attributes:
        device: The EAP device of the station.
        devices: By AMS port: who answers there.
        ports: AMS ports that it has.
    """

    def __init__(
        self, device: StationDevice, info: AdsDeviceInfo, spaces: Mapping[int, Sequence[AdsSpace]]
    ) -> None:
        self.device = device
        self.devices = {
            port: AdsDevice(info, self.states, each, first_handle=first_handle())
            for port, each in spaces.items()
        }
        self.ports = frozenset(self.devices)

    @property
    def notifications(self) -> Mapping[int, NotificationTable]:
        """Notifications of each AMS port."""
        return {port: device.notifications for port, device in self.devices.items()}

    def answer(self, request: LocalRequest) -> AmsAnswer | Awaitable[AmsAnswer]:
        """Answer a request, without a task if no operation waits."""
        header = request.header
        client = AdsClient(request.endpoint, header.source, header.source_port)
        perform = partial(self.perform, header.target_port, client)
        return begin_answer(header.command, request.body, perform)

    def client_gone(self, endpoint: Endpoint) -> None:
        """End the notifications of a connection."""
        for device in self.devices.values():
            device.notifications.forget(endpoint)

    def perform(
        self, port: int, client: AdsClient, operation: Operation
    ) -> OperationOutcome | Awaitable[OperationOutcome]:
        """Do one operation at an AMS port; another state is waited for."""
        if isinstance(operation, WriteControl):
            return control_state(self.device, operation)
        return self.devices[port].perform(operation, client, monotonic_ns())

    def states(self) -> AdsStates:
        """Return the answer to ReadState."""
        return states_of(self.device.status.state)


def device_info(name: str, release: str) -> AdsDeviceInfo:
    """Return name and version of a device; *release* is such as ``0.1.0``."""
    # A pre-release such as 0.1.0rc1 has parts that are no numbers.
    numbers = [int(part) if part.isdecimal() else 0 for part in release.split(".")]
    major, minor, build = (*numbers, 0, 0, 0)[:3]
    return AdsDeviceInfo(major & 0xFF, minor & 0xFF, build & 0xFFFF, device_name(name))


def check_up(name: str, bus: BusDescription) -> None:
    """Raise AdsRefusedError if no slave of a bus can be reached."""
    if not bus.is_reachable:
        raise AdsRefusedError(AdsError.HOST_UNREACHABLE, bus.describe_obstacle(name))
