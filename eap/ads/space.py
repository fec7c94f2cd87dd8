"""What stands behind index groups: the part of a device that a family of them belongs to."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import NoReturn, TypeAlias

from eap.ads.operation import AdsRefusedError
from eap.codec.ads import AdsError

Source: TypeAlias = Callable[[], bytes]
"""Gives the octets that a notification watches, whenever it is called.

It raises AdsRefusedError: BUSY and NOT_READY for now, anything else for good.
"""


def steady(read: Callable[[], bytes], length: int) -> Source:
    """Return what gives *length* octets whenever it is called; what gets longer or shorter ends it.

    Raises:
        AdsRefusedError: there are not as many even now, or what *read* raises.
    """

    def source() -> bytes:
        octets = read()
        if len(octets) != length:
            raise AdsRefusedError(AdsError.SIZE)
        return octets

    source()
    return source


class AdsSpace:
    """A family of index groups; what a space does not override is refused.

    Attributes:
        groups: That it answers for.
    """

    groups: Collection[int] = ()

    def read(self, group: int, offset: int, length: int) -> bytes:
        """Return at most *length* octets; raise AdsRefusedError."""
        del group, offset, length
        _refuse()

    def write(self, group: int, offset: int, data: bytes) -> None:
        """Write *data*, or raise AdsRefusedError and write nothing."""
        del group, offset, data
        _refuse()

    def read_write(self, group: int, offset: int, length: int, data: bytes) -> bytes:
        """Write *data* and return at most *length* octets; raise AdsRefusedError."""
        del group, offset, length, data
        _refuse()

    def watch(self, group: int, offset: int, length: int) -> Source:
        """Return what gives exactly *length* octets of this place; raise AdsRefusedError."""
        del group, offset, length
        _refuse()


def _refuse() -> NoReturn:
    raise AdsRefusedError(AdsError.ACCESS)
