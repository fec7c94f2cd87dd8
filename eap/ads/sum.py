"""Sum commands: many operations in one ReadWrite, and their outcomes in one answer.

The layouts are those of the header AdsDef.h of Beckhoff's AdsLib.  SUM_READ_EX answers with the
requested lengths, padded with zeros, SUM_READ_EX_2 with those that were read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from eap.ads.operation import (
    AdsRefusedError,
    DeleteNotification,
    Operation,
    OperationOutcome,
    Read,
    ReadWrite,
    Write,
)
from eap.codec.ads import AdsError, AdsRange, AdsReadWrite, IndexGroup, encode_result
from eap.codec.adsnotification import AddNotification

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
