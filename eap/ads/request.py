"""ADS requests taken apart into operations, and the answers put together again.

Beckhoff ADS specification, commands 1 to 7 and 9.  Whoever cannot answer at once, because a bus
lies between, does what ``AdsDevice.answer`` does in steps of its own: ``take_request``, one
outcome for each operation into ``Outcomes``, ``answer``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from eap.ads.answer import AmsAnswer
from eap.ads.operation import (
    AdsRefusedError,
    Operation,
    OperationOutcome,
    ReadDeviceInfo,
    ReadState,
    ReadWrite,
    Write,
    WriteControl,
)
from eap.ads.sum import SUM_COMMANDS, asked_length, padded, parse_delete, parse_read, taken
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
MAX_ITEMS = 10_000
"""Of a sum command; Beckhoff advises 500.  Others wait while a request is taken apart."""
_HEAD_SIZE = 8
"""Octets of a result and of what stands beside it in the answer of a sum command."""
_REASONS = 3
"""That are told of one request, for a sum command may have thousands."""


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
    """How the operations of one request came out, one after the other.

    What the answer has no room for is refused as it comes, so that it need not be kept.
    """

    def __init__(self, request: AdsRequest) -> None:
        self._request = request
        self._room = MAX_ANSWER - _HEAD_SIZE * len(request.operations)
        self._outcomes: list[OperationOutcome] = []
        self._reasons: list[str] = []

    def add(self, outcome: OperationOutcome) -> None:
        """Take the outcome of the next operation."""
        if len(outcome.data) > self._room:
            outcome = OperationOutcome(AdsError.NO_MEMORY)
        self._room -= len(outcome.data)
        self._outcomes.append(outcome)
        if outcome.why:
            self._reasons.append(outcome.why)

    def answer(self) -> AmsAnswer:
        """Return the answer; there is an outcome for every operation."""
        reasons = self._reasons[:_REASONS]
        if len(self._reasons) > _REASONS:
            reasons.append(f"and {len(self._reasons) - _REASONS} more")
        return AmsAnswer(self._request.encode_answer(self._outcomes), why="; ".join(reasons))


def take_request(command: int, body: bytes) -> AdsRequest | AmsAnswer:
    """Take a request apart; return the answer to one that is none."""
    try:
        return parse_request(command, body)
    except AdsRefusedError as exc:
        if exc.result is AdsError.COMMAND:
            return AmsAnswer(error_code=exc.result)
        return AmsAnswer(encode_refusal(command, exc.result))


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


def _parse_write(body: bytes) -> Write:
    head = AdsRange.decode(body)
    return Write(head.group, head.offset, taken(body, AdsRange.SIZE, head.length))


def _parse_control(body: bytes) -> WriteControl:
    head = AdsWriteControl.decode(body)
    data = taken(body, AdsWriteControl.SIZE, head.length)
    return WriteControl(head.ads_state, head.device_state, data)


def _parse_read_write(body: bytes) -> ReadWrite:
    head = AdsReadWrite.decode(body)
    data = taken(body, AdsReadWrite.SIZE, head.write_length)
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
    if not count and request.group == IndexGroup.SUM_READ:
        count = len(request.data) // kind.item_size
    if count * kind.item_size > len(request.data):
        raise AdsRefusedError(AdsError.SIZE)
    if count > MAX_ITEMS:
        raise AdsRefusedError(AdsError.NO_MEMORY)
    operations = kind.split(count, request.data)
    padding = sum(map(asked_length, operations)) if kind.is_padded else 0
    if len(operations) * _HEAD_SIZE + padding > MAX_ANSWER:
        raise AdsRefusedError(AdsError.NO_MEMORY)
    return AdsRequest(
        AmsCommand.READ_WRITE, tuple(operations), request.group, request.length, request.offset
    )
