"""Parts of sum commands: some of the items asked for, and their answers put back among the others.

Whoever may have only some items done gets an answer to each, in the order in which he asked.
"""

from __future__ import annotations

from collections.abc import Sequence

from eap.ads.operation import Operation, OperationOutcome, ReadWrite, Write
from eap.ads.query import encode_query
from eap.ads.request import AdsRequest
from eap.ads.sum import asked_length
from eap.codec.ads import AdsReadWrite, IndexGroup

_HEAD = 8
"""Octets of result and length in front of all answers."""
_RESULT = 4
_SHORT_HEADS = frozenset(
    (IndexGroup.SUM_READ, IndexGroup.SUM_WRITE, IndexGroup.SUM_DELETE_NOTIFICATION)
)
"""Whose items are answered by a result; those of the others by a result and four octets more."""
_PADDED = frozenset((IndexGroup.SUM_READ, IndexGroup.SUM_READ_EX))
_RETURNED = frozenset((IndexGroup.SUM_READ_WRITE, IndexGroup.SUM_READ_EX_2))


def has_results(request: AdsRequest) -> bool:
    """Say whether the answer to *request* has a result for each item."""
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
            length = asked_length(operation)
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
