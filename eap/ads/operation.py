"""What an ADS client wants done, one thing at a time, and how it came out.

Every request is a list of operations: one, or those of a sum command.  Whoever grants access looks
at operations, whoever serves does them one after the other, and ``ads_request`` makes the answer of
their outcomes.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

from eap.codec.ads import AdsError
from eap.codec.adsnotification import AddNotification


class ReadDeviceInfo(NamedTuple):
    """Who are you?"""


class ReadState(NamedTuple):
    """Which states are you in?"""


class Read(NamedTuple):
    """*length*: bytes that the client has room for."""

    group: int
    offset: int
    length: int


class Write(NamedTuple):
    """*data*: as many bytes as the request says."""

    group: int
    offset: int
    data: bytes


class ReadWrite(NamedTuple):
    """*length*: bytes that the client has room for."""

    group: int
    offset: int
    length: int
    data: bytes


class WriteControl(NamedTuple):
    """Take these states."""

    ads_state: int
    device_state: int
    data: bytes


class DeleteNotification(NamedTuple):
    """Take a handle back."""

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
    """How an operation came out."""

    result: int = AdsError.NONE
    data: bytes = b""
    """What stands behind the result; of a Read or ReadWrite without its length."""
    why: str = ""
    """For people, where there is more to say than the result does."""


class AdsRefusedError(Exception):
    """An operation that is answered with a result other than 0; *why* is for people."""

    def __init__(self, result: AdsError, why: str = "") -> None:
        super().__init__(f"{result.name}: {why}" if why else result.name)
        self.result = result
        self.why = why
