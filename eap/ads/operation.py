"""Operations of ADS requests, and their outcomes.

Every request is a list of operations: one, or those of a sum command.  Access rules are applied to
operations, a server carries them out one after the other, and ``request`` encodes the answer from
their outcomes.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

from eap.codec.ads import AdsError
from eap.codec.adsnotification import AddNotification


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
