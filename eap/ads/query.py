"""The side of a client: operations as requests, and answers as their outcomes.

The other way round than ``ads_request``; for whoever asks others on somebody's behalf.
"""

from __future__ import annotations

from eap.ads.operation import (
    DeleteNotification,
    Operation,
    OperationOutcome,
    Read,
    ReadDeviceInfo,
    ReadState,
    ReadWrite,
    Write,
    WriteControl,
)
from eap.codec.ads import AdsError, AdsRange, AdsReadWrite, AdsWriteControl
from eap.codec.adsnotification import AddNotification
from eap.codec.ams import AmsCommand

_COMMANDS: dict[type[Operation], AmsCommand] = {
    ReadDeviceInfo: AmsCommand.READ_DEVICE_INFO,
    Read: AmsCommand.READ,
    Write: AmsCommand.WRITE,
    ReadState: AmsCommand.READ_STATE,
    WriteControl: AmsCommand.WRITE_CONTROL,
    AddNotification: AmsCommand.ADD_NOTIFICATION,
    DeleteNotification: AmsCommand.DELETE_NOTIFICATION,
    ReadWrite: AmsCommand.READ_WRITE,
}
_RESULT_SIZE = 4
_LENGTH_SIZE = 4
_WITH_LENGTH = frozenset((AmsCommand.READ, AmsCommand.READ_WRITE))


def encode_query(operation: Operation) -> tuple[AmsCommand, bytes]:
    """Return command and body of the request for one operation."""
    command = _COMMANDS[type(operation)]
    match operation:
        case Read(group, offset, length):
            body = AdsRange(group, offset, length).encode()
        case Write(group, offset, data):
            body = AdsRange(group, offset, len(data)).encode() + data
        case ReadWrite(group, offset, length, data):
            body = AdsReadWrite(group, offset, length, len(data)).encode() + data
        case WriteControl(ads_state, device_state, data):
            body = AdsWriteControl(ads_state, device_state, len(data)).encode() + data
        case AddNotification():
            body = operation.encode()
        case DeleteNotification(handle):
            body = handle.to_bytes(4, "little")
        case _:
            body = b""
    return command, body


def decode_outcome(command: int, error_code: int, body: bytes) -> OperationOutcome:
    """Return how a request with one operation came out.

    What is too short to be an answer comes out as SIZE.

    Args:
        command: Of the request.
        error_code: Of the AMS header of its answer.
        body: What follows that.
    """
    if error_code:
        return OperationOutcome(error_code)
    if len(body) < _RESULT_SIZE:
        return OperationOutcome(AdsError.SIZE, why=f"an answer of {len(body)} octets")
    result = int.from_bytes(body[:_RESULT_SIZE], "little")
    data = body[_RESULT_SIZE:]
    if result:
        return OperationOutcome(result)
    if command in _WITH_LENGTH:
        length, data = int.from_bytes(data[:_LENGTH_SIZE], "little"), data[_LENGTH_SIZE:]
        if len(data) < length:
            return OperationOutcome(AdsError.SIZE, why=f"{len(data)} octets of {length}")
        data = data[:length]
    return OperationOutcome(data=data)
