"""ADS requests: their operations, sum commands, and answers, on both sides.

Beckhoff ADS specification, commands 1 to 7 and 9.  Every request is a list of operations: one, or
those of a sum command.  Access rules are applied to operations, a server carries them out one after
the other, and the answer is encoded from their outcomes.

A server that cannot answer at once, because a bus lies between, does the work of
``AdsDevice.answer`` in steps of its own: ``accept_request``, one outcome for each operation into
``Outcomes``, ``answer``.  A client that may have only some items of a sum command done still gets
an answer to each of them, in its own order.

The layouts of sum commands are those of the header AdsDef.h of Beckhoff's AdsLib.  SUM_READ_EX
answers with the requested lengths, padded with zeros, SUM_READ_EX_2 with those that were read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, TypeAlias

from eap.codec.ads import (
    AdsError,
    AdsRange,
    AdsReadWrite,
    AdsWriteControl,
    IndexGroup,
    encode_result,
)
from eap.codec.adsnotification import AddNotification
from eap.codec.ams import AmsAnswer, AmsCommand
from eap.errors import TruncatedError


class ReadDeviceInfo(NamedTuple):
    """Request for name and version."""


class ReadState(NamedTuple):
    """Request for ADS state and device state."""


class Read(NamedTuple):
    """*length*: bytes that the client accepts."""

    group: int
    offset: int
    length: int


class Write(NamedTuple):
    """*data*: as many bytes as the request says."""

    group: int
    offset: int
    data: bytes


class ReadWrite(NamedTuple):
    """*length*: bytes that the client accepts."""

    group: int
    offset: int
    length: int
    data: bytes


class WriteControl(NamedTuple):
    """Request to change the states."""

    ads_state: int
    device_state: int
    data: bytes


class DeleteNotification(NamedTuple):
    """Request to end a notification."""

    handle: int


Operation: TypeAlias = (
    ReadDeviceInfo
    | ReadState
    | Read
    | Write
    | ReadWrite
    | WriteControl
    | AddNotification
    | DeleteNotification
)


class OperationOutcome(NamedTuple):
    """Outcome of an operation."""

    result: int = AdsError.NONE
    data: bytes = b""
    """Data behind the result; of a Read or ReadWrite without its length."""
    why: str = ""
    """Detail for operators beyond the result."""


class AdsRefusedError(Exception):
    """An operation that is answered with a result other than 0; *why* is for operators."""

    def __init__(self, result: AdsError, why: str = "") -> None:
        super().__init__(f"{result.name}: {why}" if why else result.name)
        self.result = result
        self.why = why


_HANDLE_SIZE = 4


class SumCommand(NamedTuple):
    """One of the sum commands."""

    item_size: int
    """Bytes that each item has at the front of the request."""
    split: Callable[[int, bytes], list[Operation]]
    join: Callable[[Sequence[Operation], Sequence[OperationOutcome]], bytes]
    is_padded: bool = False
    """True if the answer has the requested lengths, whatever was read."""


def parse_read(body: bytes) -> Read:
    """Return a Read; raise TruncatedError."""
    head = AdsRange.decode(body)
    return Read(head.group, head.offset, head.length)


def parse_delete(body: bytes) -> DeleteNotification:
    """Return a DeleteNotification; refuse with SIZE if there is no handle."""
    return DeleteNotification(int.from_bytes(read_exactly(body, 0, _HANDLE_SIZE), "little"))


def read_exactly(data: bytes, start: int, length: int) -> bytes:
    """Return *length* bytes from *start*; refuse with SIZE if there are fewer."""
    if len(data) - start < length:
        raise AdsRefusedError(AdsError.SIZE)
    return bytes(data[start : start + length])


def requested_length(operation: Operation) -> int:
    """Return the number of bytes that a client accepts."""
    return operation.length if isinstance(operation, Read | ReadWrite) else 0


def padded(operations: Sequence[Operation], outcomes: Sequence[OperationOutcome]) -> bytes:
    """Return the data of all items, each with its requested length."""
    return b"".join(
        outcome.data.ljust(requested_length(operation), b"\0")
        for operation, outcome in zip(operations, outcomes, strict=True)
    )


def _split_reads(count: int, data: bytes) -> list[Operation]:
    return [parse_read(data[at : at + AdsRange.SIZE]) for at in _starts(count, AdsRange.SIZE)]


def _split_writes(count: int, data: bytes) -> list[Operation]:
    items: list[Operation] = []
    behind = count * AdsRange.SIZE
    for at in _starts(count, AdsRange.SIZE):
        head = AdsRange.decode(data, at)
        items.append(Write(head.group, head.offset, read_exactly(data, behind, head.length)))
        behind += head.length
    return items


def _split_read_writes(count: int, data: bytes) -> list[Operation]:
    items: list[Operation] = []
    behind = count * AdsReadWrite.SIZE
    for at in _starts(count, AdsReadWrite.SIZE):
        head = AdsReadWrite.decode(data, at)
        written = read_exactly(data, behind, head.write_length)
        items.append(ReadWrite(head.group, head.offset, head.read_length, written))
        behind += head.write_length
    return items


def _split_adds(count: int, data: bytes) -> list[Operation]:
    size = AddNotification.SIZE
    return [AddNotification.decode(data, at) for at in _starts(count, size)]


def _split_deletes(count: int, data: bytes) -> list[Operation]:
    return [parse_delete(data[at : at + _HANDLE_SIZE]) for at in _starts(count, _HANDLE_SIZE)]


def _starts(count: int, size: int) -> Iterable[int]:
    return range(0, count * size, size)


def _results(outcomes: Iterable[OperationOutcome]) -> bytes:
    # All results come first, then all data: clients find the data by the lengths of their request.
    return b"".join(encode_result(item.result) for item in outcomes)


def _join_reads(operations: Sequence[Operation], outcomes: Sequence[OperationOutcome]) -> bytes:
    return _results(outcomes) + padded(operations, outcomes)


def _join_results(_: Sequence[Operation], outcomes: Sequence[OperationOutcome]) -> bytes:
    return _results(outcomes)


def _join_requested(operations: Sequence[Operation], outcomes: Sequence[OperationOutcome]) -> bytes:
    heads = b"".join(
        encode_result(outcome.result) + requested_length(operation).to_bytes(4, "little")
        for operation, outcome in zip(operations, outcomes, strict=True)
    )
    return heads + padded(operations, outcomes)


def _join_returned(_: Sequence[Operation], outcomes: Sequence[OperationOutcome]) -> bytes:
    heads = b"".join(
        encode_result(item.result) + len(item.data).to_bytes(4, "little") for item in outcomes
    )
    return heads + b"".join(item.data for item in outcomes)


def _join_handles(_: Sequence[Operation], outcomes: Sequence[OperationOutcome]) -> bytes:
    return b"".join(
        encode_result(item.result) + item.data.ljust(_HANDLE_SIZE, b"\0") for item in outcomes
    )


# AdsDef.h: 0xF083 answers with padded values, 0xF084 with their real lengths.
SUM_COMMANDS: dict[int, SumCommand] = {
    IndexGroup.SUM_READ: SumCommand(AdsRange.SIZE, _split_reads, _join_reads, is_padded=True),
    IndexGroup.SUM_WRITE: SumCommand(AdsRange.SIZE, _split_writes, _join_results),
    IndexGroup.SUM_READ_WRITE: SumCommand(AdsReadWrite.SIZE, _split_read_writes, _join_returned),
    IndexGroup.SUM_READ_EX: SumCommand(
        AdsRange.SIZE, _split_reads, _join_requested, is_padded=True
    ),
    IndexGroup.SUM_READ_EX_2: SumCommand(AdsRange.SIZE, _split_reads, _join_returned),
    IndexGroup.SUM_ADD_NOTIFICATION: SumCommand(AddNotification.SIZE, _split_adds, _join_handles),
    IndexGroup.SUM_DELETE_NOTIFICATION: SumCommand(_HANDLE_SIZE, _split_deletes, _join_results),
}


MAX_ANSWER = 1 << 20
"""Bytes of the longest answer; a sum command that requests more is refused as a whole."""
MAX_ITEMS = 10_000
"""Of a sum command; Beckhoff advises 500.  Others wait while a request is taken apart."""
_HEAD_SIZE = 8
"""Bytes of a result and of what stands beside it in the answer of a sum command."""
# A sum command may fail thousands of times over.
_REASONS = 3
"""Reasons kept for one request."""


class AdsRequest(NamedTuple):
    """One request: its operations and the form of its answer."""

    command: int
    operations: tuple[Operation, ...]
    sum_group: int = 0
    """Of a sum command, else 0."""
    read_length: int = 0
    """Bytes that a client accepts in the answer to a sum command."""
    index_offset: int = 0
    """Of a sum command: how many items it has, or 0."""

    def encode_answer(self, outcomes: Sequence[OperationOutcome]) -> bytes:
        """Return the body of the answer; *outcomes* are in the order of the operations."""
        if not self.sum_group:
            (outcome,) = outcomes
            return encode_outcome(self.command, outcome)
        if self.sum_group == IndexGroup.SUM_READ and not self.index_offset:
            # Without results of its own, an item that failed is the result of the whole.
            result = next((item.result for item in outcomes if item.result), AdsError.NONE)
            data = padded(self.operations, outcomes)
        else:
            result = AdsError.NONE
            data = SUM_COMMANDS[self.sum_group].join(self.operations, outcomes)
        if len(data) > min(self.read_length, MAX_ANSWER):
            return encode_refusal(self.command, AdsError.SIZE)
        return encode_result(result, data)


class Outcomes:
    """Outcomes of the operations of one request, one after the other.

    Data that exceeds the answer is refused as it comes, so that it is not kept.
    """

    def __init__(self, request: AdsRequest) -> None:
        self._request = request
        self._space_left = MAX_ANSWER - _HEAD_SIZE * len(request.operations)
        self._outcomes: list[OperationOutcome] = []
        self._reasons: list[str] = []

    def add(self, outcome: OperationOutcome) -> None:
        """Take the outcome of the next operation."""
        if len(outcome.data) > self._space_left:
            outcome = OperationOutcome(AdsError.NO_MEMORY)
        self._space_left -= len(outcome.data)
        self._outcomes.append(outcome)
        if outcome.why:
            self._reasons.append(outcome.why)

    def answer(self) -> AmsAnswer:
        """Return the answer; there is an outcome for every operation."""
        reasons = self._reasons[:_REASONS]
        if len(self._reasons) > _REASONS:
            reasons.append(f"and {len(self._reasons) - _REASONS} more")
        return AmsAnswer(self._request.encode_answer(self._outcomes), why="; ".join(reasons))


def accept_request(command: int, body: bytes) -> AdsRequest | AmsAnswer:
    """Parse a request; return the answer to a malformed one."""
    try:
        return parse_request(command, body)
    except AdsRefusedError as exc:
        # An unknown command has no answer layout, so the error goes into the AMS header.
        if exc.result is AdsError.COMMAND:
            return AmsAnswer(error_code=exc.result)
        return AmsAnswer(encode_refusal(command, exc.result))


def parse_request(command: int, body: bytes) -> AdsRequest:
    """Parse a request.

    Raises:
        AdsRefusedError: it is too short (SIZE), requests too much at once (NO_MEMORY), or is of
            a command that is none (COMMAND, which belongs into the AMS header).
    """
    parser = _PARSERS.get(command)
    if parser is None:
        raise AdsRefusedError(AdsError.COMMAND)
    try:
        operation = parser(body)
        if isinstance(operation, ReadWrite) and operation.group in SUM_COMMANDS:
            return _parse_sum(operation)
    except TruncatedError:
        raise AdsRefusedError(AdsError.SIZE) from None
    return AdsRequest(command, (operation,))


def encode_outcome(command: int, outcome: OperationOutcome) -> bytes:
    """Return the body of the answer to a *command* with one operation."""
    if outcome.result:
        return encode_refusal(command, outcome.result)
    if command in _WITH_LENGTH:
        return encode_result(outcome.result, outcome.data)
    return encode_result(outcome.result) + outcome.data


def encode_refusal(command: int, result: int) -> bytes:
    """Return the body of an answer with a result other than 0 and no data."""
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
"""Bytes of an answer behind its result when there is no data."""


def _parse_write(body: bytes) -> Write:
    head = AdsRange.decode(body)
    return Write(head.group, head.offset, read_exactly(body, AdsRange.SIZE, head.length))


def _parse_control(body: bytes) -> WriteControl:
    head = AdsWriteControl.decode(body)
    data = read_exactly(body, AdsWriteControl.SIZE, head.length)
    return WriteControl(head.ads_state, head.device_state, data)


def _parse_read_write(body: bytes) -> ReadWrite:
    head = AdsReadWrite.decode(body)
    data = read_exactly(body, AdsReadWrite.SIZE, head.write_length)
    return ReadWrite(head.group, head.offset, head.read_length, data)


_PARSERS: dict[int, Callable[[bytes], Operation]] = {
    AmsCommand.READ_DEVICE_INFO: lambda _: ReadDeviceInfo(),
    AmsCommand.READ: parse_read,
    AmsCommand.WRITE: _parse_write,
    AmsCommand.READ_STATE: lambda _: ReadState(),
    AmsCommand.WRITE_CONTROL: _parse_control,
    AmsCommand.ADD_NOTIFICATION: AddNotification.decode,
    AmsCommand.DELETE_NOTIFICATION: parse_delete,
    AmsCommand.READ_WRITE: _parse_read_write,
}


def _parse_sum(request: ReadWrite) -> AdsRequest:
    kind = SUM_COMMANDS[request.group]
    count = request.offset
    # SUM_READ with offset 0 gives no count: the items fill the data, and have no results.
    if not count and request.group == IndexGroup.SUM_READ:
        count = len(request.data) // kind.item_size
    if count * kind.item_size > len(request.data):
        raise AdsRefusedError(AdsError.SIZE)
    if count > MAX_ITEMS:
        raise AdsRefusedError(AdsError.NO_MEMORY)
    operations = kind.split(count, request.data)
    padding = sum(map(requested_length, operations)) if kind.is_padded else 0
    if len(operations) * _HEAD_SIZE + padding > MAX_ANSWER:
        raise AdsRefusedError(AdsError.NO_MEMORY)
    return AdsRequest(
        AmsCommand.READ_WRITE, tuple(operations), request.group, request.length, request.offset
    )


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
        return OperationOutcome(AdsError.SIZE, why=f"an answer of {len(body)} bytes")
    result = int.from_bytes(body[:_RESULT_SIZE], "little")
    data = body[_RESULT_SIZE:]
    if result:
        return OperationOutcome(result)
    if command in _WITH_LENGTH:
        length, data = int.from_bytes(data[:_LENGTH_SIZE], "little"), data[_LENGTH_SIZE:]
        if len(data) < length:
            return OperationOutcome(AdsError.SIZE, why=f"{len(data)} bytes of {length}")
        data = data[:length]
    return OperationOutcome(data=data)


_HEAD = 8
"""Bytes of result and length in front of all answers."""
_RESULT = 4
_SHORT_HEADS = frozenset(
    (IndexGroup.SUM_READ, IndexGroup.SUM_WRITE, IndexGroup.SUM_DELETE_NOTIFICATION)
)
"""Their items are answered by a result, those of the others by a result and four bytes."""
_PADDED = frozenset((IndexGroup.SUM_READ, IndexGroup.SUM_READ_EX))
_RETURNED = frozenset((IndexGroup.SUM_READ_WRITE, IndexGroup.SUM_READ_EX_2))


def has_results(request: AdsRequest) -> bool:
    """Return whether the answer to *request* has a result for each item."""
    return bool(request.sum_group) and (
        request.sum_group != IndexGroup.SUM_READ or bool(request.index_offset)
    )


def part_of(request: AdsRequest, operations: Sequence[Operation]) -> AdsRequest:
    """Return a sum command with only some *operations* of *request*."""
    return request._replace(operations=tuple(operations), index_offset=len(operations))


def encode_sum(request: AdsRequest) -> bytes:
    """Return the body of the ReadWrite that is a sum command."""
    heads, behind = [], []
    for operation in request.operations:
        _, body = encode_query(operation)
        data = operation.data if isinstance(operation, Write | ReadWrite) else b""
        heads.append(body[: len(body) - len(data)])
        behind.append(data)
    items = b"".join(heads + behind)
    head = AdsReadWrite(request.sum_group, request.index_offset, request.read_length, len(items))
    return head.encode() + items


def split_answer(request: AdsRequest, body: bytes) -> list[OperationOutcome] | None:
    """Return how each item of a sum command came out, None if it failed as a whole."""
    if len(body) < _HEAD or any(body[:_RESULT]):
        return None
    data = body[_HEAD:]
    operations, group = request.operations, request.sum_group
    size = _RESULT if group in _SHORT_HEADS else 2 * _RESULT
    if len(data) < size * len(operations):
        return None
    outcomes, at = [], size * len(operations)
    for number, operation in enumerate(operations):
        head = data[number * size : (number + 1) * size]
        if group in _PADDED:
            length = requested_length(operation)
        else:
            length = int.from_bytes(head[_RESULT:], "little") if group in _RETURNED else 0
        found = data[at : at + length]
        if len(found) < length:
            return None
        at += length
        if group == IndexGroup.SUM_ADD_NOTIFICATION:
            found = head[_RESULT:]
        outcomes.append(OperationOutcome(int.from_bytes(head[:_RESULT], "little"), found))
    return outcomes
