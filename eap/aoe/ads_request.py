"""ADS requests taken apart into operations, and the answers put together again.

Beckhoff ADS specification, commands 1 to 7 and 9; the layouts of sum commands are those of the
header AdsDef.h of Beckhoff's AdsLib.  SUM_READ_EX answers with the lengths that were asked for,
padded with zeros, SUM_READ_EX_2 with those that were read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from eap.aoe.ads_operation import (
    AdsRefusedError,
    DeleteNotification,
    Operation,
    Outcome,
    Read,
    ReadDeviceInfo,
    ReadState,
    ReadWrite,
    Write,
    WriteControl,
)
from eap.codec.ads import (
    AdsError,
    AdsRange,
    AdsReadWrite,
    AdsWriteControl,
    IndexGroup,
    encode_result,
)
from eap.codec.adsnotification import AddNotification
from eap.codec.ams import AmsCommand
from eap.errors import TruncatedError

MAX_ANSWER = 1 << 20
"""Octets of the longest answer; a sum command that asks for more is refused as a whole."""
_HANDLE_SIZE = 4
_RESULT_SIZE = 4


class _Sum(NamedTuple):
    """One of the sum commands."""

    item_size: int
    """Octets that each item has at the front of the request."""
    split: Callable[[int, bytes], list[Operation]]
    join: Callable[[Sequence[Operation], Sequence[Outcome]], bytes]


class AdsRequest(NamedTuple):
    """One request: what it asks for, and how its answer is made."""

    command: int
    operations: tuple[Operation, ...]
    sum_group: int = 0
    """Of a sum command, else 0."""
    read_length: int = 0
    """Octets that a client has room for in the answer of a sum command."""
    index_offset: int = 0
    """Of a sum command: how many items it has, or 0."""

    def encode_answer(self, outcomes: Sequence[Outcome]) -> bytes:
        """Return the body of the answer; *outcomes* are in the order of the operations."""
        if not self.sum_group:
            (outcome,) = outcomes
            return encode_outcome(self.command, outcome)
        if self.sum_group == IndexGroup.SUM_READ and not self.index_offset:
            # Without results of its own, an item that failed is the result of the whole.
            result = next((item.result for item in outcomes if item.result), AdsError.NONE)
            data = _padded(self.operations, outcomes)
        else:
            result = AdsError.NONE
            data = _SUMS[self.sum_group].join(self.operations, outcomes)
        if len(data) > min(self.read_length, MAX_ANSWER):
            return encode_refusal(self.command, AdsError.SIZE)
        return encode_result(result, data)


def parse_request(command: int, body: bytes) -> AdsRequest:
    """Take a request apart.

    Raises:
        AdsRefusedError: it is too short (SIZE), asks for too much at once (NO_MEMORY), or is of
            a command that is none (COMMAND, which belongs into the AMS header).
    """
    parser = _PARSERS.get(command)
    if parser is None:
        raise AdsRefusedError(AdsError.COMMAND)
    try:
        operation = parser(body)
        if isinstance(operation, ReadWrite) and operation.group in _SUMS:
            return _parse_sum(operation)
    except TruncatedError:
        raise AdsRefusedError(AdsError.SIZE) from None
    return AdsRequest(command, (operation,))


def encode_outcome(command: int, outcome: Outcome) -> bytes:
    """Return the body of the answer to a *command* with one operation."""
    if outcome.result:
        return encode_refusal(command, outcome.result)
    if command in _WITH_LENGTH:
        return encode_result(outcome.result, outcome.data)
    return encode_result(outcome.result) + outcome.data


def encode_refusal(command: int, result: int) -> bytes:
    """Return the body of an answer that says only why there is none."""
    # Clients unpack what stands behind the result whatever the result is.
    return encode_result(result) + bytes(_BEHIND_RESULT.get(command, 0))


_WITH_LENGTH = frozenset((AmsCommand.READ, AmsCommand.READ_WRITE))
_BEHIND_RESULT: dict[int, int] = {
    AmsCommand.READ_DEVICE_INFO: 20,
    AmsCommand.READ: 4,
    AmsCommand.READ_STATE: 4,
    AmsCommand.ADD_NOTIFICATION: 4,
    AmsCommand.READ_WRITE: 4,
}
"""Octets of an answer behind its result when there is no data."""


def _parse_read(body: bytes) -> Read:
    asked = AdsRange.decode(body)
    return Read(asked.group, asked.offset, asked.length)


def _parse_write(body: bytes) -> Write:
    head = AdsRange.decode(body)
    return Write(head.group, head.offset, _taken(body, AdsRange.SIZE, head.length))


def _parse_control(body: bytes) -> WriteControl:
    head = AdsWriteControl.decode(body)
    data = _taken(body, AdsWriteControl.SIZE, head.length)
    return WriteControl(head.ads_state, head.device_state, data)


def _parse_read_write(body: bytes) -> ReadWrite:
    head = AdsReadWrite.decode(body)
    data = _taken(body, AdsReadWrite.SIZE, head.write_length)
    return ReadWrite(head.group, head.offset, head.read_length, data)


def _parse_delete(body: bytes) -> DeleteNotification:
    return DeleteNotification(int.from_bytes(_taken(body, 0, _HANDLE_SIZE), "little"))


_PARSERS: dict[int, Callable[[bytes], Operation]] = {
    AmsCommand.READ_DEVICE_INFO: lambda _: ReadDeviceInfo(),
    AmsCommand.READ: _parse_read,
    AmsCommand.WRITE: _parse_write,
    AmsCommand.READ_STATE: lambda _: ReadState(),
    AmsCommand.WRITE_CONTROL: _parse_control,
    AmsCommand.ADD_NOTIFICATION: AddNotification.decode,
    AmsCommand.DELETE_NOTIFICATION: _parse_delete,
    AmsCommand.READ_WRITE: _parse_read_write,
}


def _parse_sum(request: ReadWrite) -> AdsRequest:
    kind = _SUMS[request.group]
    count = request.offset
    if not count and request.group == IndexGroup.SUM_READ:
        count = len(request.data) // kind.item_size
    if count * kind.item_size > len(request.data):
        raise AdsRefusedError(AdsError.SIZE)
    operations = kind.split(count, request.data)
    if sum(map(_room, operations)) > MAX_ANSWER:
        raise AdsRefusedError(AdsError.NO_MEMORY)
    return AdsRequest(
        AmsCommand.READ_WRITE, tuple(operations), request.group, request.length, request.offset
    )


def _room(operation: Operation) -> int:
    return 2 * _RESULT_SIZE + _asked(operation)


def _asked(operation: Operation) -> int:
    return operation.length if isinstance(operation, Read | ReadWrite) else 0


def _split_reads(count: int, data: bytes) -> list[Operation]:
    return [_parse_read(data[at : at + AdsRange.SIZE]) for at in _starts(count, AdsRange.SIZE)]


def _split_writes(count: int, data: bytes) -> list[Operation]:
    items: list[Operation] = []
    behind = count * AdsRange.SIZE
    for at in _starts(count, AdsRange.SIZE):
        head = AdsRange.decode(data, at)
        items.append(Write(head.group, head.offset, _taken(data, behind, head.length)))
        behind += head.length
    return items


def _split_read_writes(count: int, data: bytes) -> list[Operation]:
    items: list[Operation] = []
    behind = count * AdsReadWrite.SIZE
    for at in _starts(count, AdsReadWrite.SIZE):
        head = AdsReadWrite.decode(data, at)
        written = _taken(data, behind, head.write_length)
        items.append(ReadWrite(head.group, head.offset, head.read_length, written))
        behind += head.write_length
    return items


def _split_adds(count: int, data: bytes) -> list[Operation]:
    size = AddNotification.SIZE
    return [AddNotification.decode(data, at) for at in _starts(count, size)]


def _split_deletes(count: int, data: bytes) -> list[Operation]:
    return [_parse_delete(data[at : at + _HANDLE_SIZE]) for at in _starts(count, _HANDLE_SIZE)]


def _starts(count: int, size: int) -> Iterable[int]:
    return range(0, count * size, size)


def _taken(data: bytes, start: int, length: int) -> bytes:
    """Return *length* octets from *start*; refuse with SIZE if there are fewer."""
    if len(data) - start < length:
        raise AdsRefusedError(AdsError.SIZE)
    return bytes(data[start : start + length])


def _results(outcomes: Iterable[Outcome]) -> bytes:
    return b"".join(encode_result(item.result) for item in outcomes)


def _padded(operations: Sequence[Operation], outcomes: Sequence[Outcome]) -> bytes:
    """Return what was read, each with the length that was asked for."""
    return b"".join(
        outcome.data.ljust(_asked(operation), b"\0")
        for operation, outcome in zip(operations, outcomes, strict=True)
    )


def _join_reads(operations: Sequence[Operation], outcomes: Sequence[Outcome]) -> bytes:
    return _results(outcomes) + _padded(operations, outcomes)


def _join_results(_: Sequence[Operation], outcomes: Sequence[Outcome]) -> bytes:
    return _results(outcomes)


def _join_asked(operations: Sequence[Operation], outcomes: Sequence[Outcome]) -> bytes:
    heads = b"".join(
        encode_result(outcome.result) + _asked(operation).to_bytes(4, "little")
        for operation, outcome in zip(operations, outcomes, strict=True)
    )
    return heads + _padded(operations, outcomes)


def _join_returned(_: Sequence[Operation], outcomes: Sequence[Outcome]) -> bytes:
    heads = b"".join(
        encode_result(item.result) + len(item.data).to_bytes(4, "little") for item in outcomes
    )
    return heads + b"".join(item.data for item in outcomes)


def _join_handles(_: Sequence[Operation], outcomes: Sequence[Outcome]) -> bytes:
    return b"".join(
        encode_result(item.result) + item.data.ljust(_HANDLE_SIZE, b"\0") for item in outcomes
    )


_SUMS: dict[int, _Sum] = {
    IndexGroup.SUM_READ: _Sum(AdsRange.SIZE, _split_reads, _join_reads),
    IndexGroup.SUM_WRITE: _Sum(AdsRange.SIZE, _split_writes, _join_results),
    IndexGroup.SUM_READ_WRITE: _Sum(AdsReadWrite.SIZE, _split_read_writes, _join_returned),
    IndexGroup.SUM_READ_EX: _Sum(AdsRange.SIZE, _split_reads, _join_asked),
    IndexGroup.SUM_READ_EX_2: _Sum(AdsRange.SIZE, _split_reads, _join_returned),
    IndexGroup.SUM_ADD_NOTIFICATION: _Sum(AddNotification.SIZE, _split_adds, _join_handles),
    IndexGroup.SUM_DELETE_NOTIFICATION: _Sum(_HANDLE_SIZE, _split_deletes, _join_results),
}
