"""A device with an object dictionary, wherever it is: what commands can do with one.

Two kinds fit :class:`OdDevice`: an EAP port of a running station
(:class:`eap.appliance.commands.od_station.StationOd`) and a slave behind one of its buses
(:class:`eap.appliance.commands.od_slave.SlaveOd`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol

import msgspec

from eap.codec.datatypes import DataType


class EntryInfo(msgspec.Struct, frozen=True):
    """What a device says of one entry."""

    subindex: int
    name: str
    kind: DataType | None
    """None if it does not tell, or tells of a type that we do not know."""
    access: str
    """``r``, ``w`` or ``rw``, empty if it does not tell."""
    unit: str = ""


class ObjectInfo(msgspec.Struct, frozen=True):
    """What a device says of one object."""

    index: int
    name: str
    code: str
    """VAR, ARRAY, RECORD, or its number."""
    max_subindex: int
    label: str = ""
    """Name of what it is about, if the device tells."""
    entries: tuple[EntryInfo, ...] = ()
    """In the order of their subindexes; gaps are left out."""


class Content(msgspec.Struct, frozen=True):
    """One entry with its octets, or with the reason why they cannot be read."""

    object: ObjectInfo
    entry: EntryInfo
    octets: bytes | None
    error: str = ""


class OdDevice(Protocol):
    """A device with an object dictionary."""

    def objects(self) -> Sequence[ObjectInfo]:
        """Return all objects in the order of their indexes, without their entries."""

    def describe(self, index: int) -> ObjectInfo:
        """Return one object with its entries; refuse as ``read`` does."""

    def entry(self, index: int, subindex: int) -> EntryInfo | None:
        """Return what is known of an entry, also of one that a download would make.

        None if the device does not tell; raises if it does, and there can be no such entry.
        """

    def read(self, index: int, subindex: int, *, complete: bool = False) -> bytes:
        """Return the octets of an entry or, with *complete*, of an object; raise if refused."""

    def write(self, index: int, subindex: int, octets: bytes, *, complete: bool = False) -> None:
        """Write an entry or, with *complete*, an object; raise if refused."""

    def contents(self) -> Iterable[Content]:
        """Return all entries of all objects."""
