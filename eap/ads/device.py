"""ADS device: the services behind one NetID and port."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

from eap.ads.notifications import AdsClient, NotificationTable
from eap.ads.request import (
    AdsRefusedError,
    Operation,
    OperationOutcome,
    Outcomes,
    Read,
    ReadDeviceInfo,
    ReadState,
    ReadWrite,
    Write,
    WriteControl,
    accept_request,
)
from eap.ads.space import AdsSpace, DeviceDataSpace, States
from eap.codec.ads import AdsDeviceInfo, AdsError
from eap.codec.adsnotification import AddNotification
from eap.codec.ams import AmsAnswer

FIRST_CHANGE_NS = 100_000_000
"""AdsLib drops samples that come before its caller has seen the answer with their handle.  Where a
value does not change, that is the only one."""

Control: TypeAlias = Callable[[WriteControl], None]
"""Acts on a WriteControl, or raises AdsRefusedError."""


def refuse_control(request: WriteControl) -> None:
    """Refuse any WriteControl."""
    del request
    raise AdsRefusedError(AdsError.SERVICE)


class AdsDevice:
    """The services of one device.

    Args:
        info: Answer to ReadDeviceInfo.
        states: Source of the answer to ReadState.
        spaces: That read and write; the first that has an index group answers for it.
        control: Acts on WriteControl.
        first_handle: Of its notifications.

    Attributes:
        notifications: Of its clients; the caller reports the end of each cycle.
    """

    def __init__(
        self,
        info: AdsDeviceInfo,
        states: States,
        spaces: Sequence[AdsSpace],
        *,
        control: Control = refuse_control,
        first_handle: int = 1,
    ) -> None:
        self.notifications = NotificationTable(first_handle, FIRST_CHANGE_NS)
        self._info = info
        self._states = states
        self._spaces = (*spaces, DeviceDataSpace(states))
        self._control = control

    def answer(self, command: int, body: bytes, client: AdsClient, now_ns: int) -> AmsAnswer:
        """Carry out a request.

        Args:
            command: Of the AMS header.
            body: What follows the header.
            client: Owner of the notifications.
            now_ns: The time on the monotonic clock.
        """
        request = accept_request(command, body)
        if isinstance(request, AmsAnswer):
            return request
        outcomes = Outcomes(request)
        for operation in request.operations:
            outcomes.add(self.perform(operation, client, now_ns))
        return outcomes.answer()

    def read(self, group: int, offset: int, length: int) -> bytes:
        """Return the data of a Read; raise AdsRefusedError."""
        return _fitting(self._space(group).read(group, offset, length), length)

    def perform(self, operation: Operation, client: AdsClient, now_ns: int) -> OperationOutcome:
        """Do one operation."""
        try:
            return OperationOutcome(data=self._perform(operation, client, now_ns))
        except AdsRefusedError as exc:
            return OperationOutcome(exc.result, why=exc.why)

    def _perform(self, operation: Operation, client: AdsClient, now_ns: int) -> bytes:
        match operation:
            case Read(group, offset, length):
                return self.read(group, offset, length)
            case Write(group, offset, data):
                self._space(group).write(group, offset, data)
            case ReadWrite(group, offset, length, data):
                space = self._space(group)
                return _fitting(space.read_write(group, offset, length, data), length)
            case ReadState():
                return self._states().encode()
            case ReadDeviceInfo():
                return self._info.encode()
            case WriteControl():
                self._control(operation)
            case AddNotification(group, offset, length):
                source = self._space(group).watch(group, offset, length)
                handle = self.notifications.add(client, operation, source, now_ns)
                return handle.to_bytes(4, "little")
            case _:
                self.notifications.delete(client, operation.handle)
        return b""

    def _space(self, group: int) -> AdsSpace:
        for space in self._spaces:
            if group in space.groups:
                return space
        raise AdsRefusedError(AdsError.INDEX_GROUP)


def _fitting(data: bytes, length: int) -> bytes:
    if len(data) > length:
        raise AdsRefusedError(AdsError.SIZE)
    return data
