"""The object dictionary of an EAP port of a running station, over the control protocol."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from msgspec.structs import replace

from eap.appliance.commands.client import Client
from eap.appliance.commands.od_device import Content, EntryInfo, ObjectInfo
from eap.appliance.control import ErrorCode
from eap.codec import datatypes
from eap.errors import ControlError
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.profiles.eap1000 import CONTROL


class StationOd:
    """The objects of *target*, which is STATION or STATION/PORT.

    Raises:
        ControlError: (every method) the station refuses, with code ``abort`` where the dictionary
            did, or the appliance does not answer.
        SdoAbortError: (``entry``) there is no such entry, and none can be made.
    """

    def __init__(self, client: Client, target: str) -> None:
        self._client = client
        self._target = target

    def objects(self) -> list[ObjectInfo]:
        """Return all objects without their entries."""
        return [_object(row) for row in self._pages("od_list")]

    def describe(self, index: int) -> ObjectInfo:
        """Return one object with its entries."""
        return _described(self._request("od_describe", index=index))

    def entry(self, index: int, subindex: int) -> EntryInfo:
        """Return what is known of an entry, also of one that a download would make."""
        found = _described(self._request("od_describe", index=index, subindex=subindex))
        for each in found.entries:
            if each.subindex == subindex:
                return each
        raise SdoAbortError(AbortCode.NO_SUBINDEX, index, subindex)

    def read(self, index: int, subindex: int, *, complete: bool = False) -> bytes:
        """Return the octets of an entry or of an object."""
        where = {"index": index, "subindex": subindex, "complete": complete}
        return bytes.fromhex(self._request("od_read", **where)["data"])

    def write(self, index: int, subindex: int, octets: bytes, *, complete: bool = False) -> None:
        """Write an entry or an object; a refusal says what to do about it, if that is known."""
        where = {"index": index, "subindex": subindex, "complete": complete}
        try:
            self._request("od_write", **where, data=octets.hex())
        except ControlError as exc:
            # At the control word it is a state that was refused, and the reason says why.
            if (
                index != CONTROL
                and exc.code == ErrorCode.ABORT
                and f"0x{AbortCode.DEVICE_STATE:08X}" in str(exc)
            ):
                hint = f"bring it to PREOP first: eapctl state {self._target} PREOP"
                raise ControlError(f"{exc}; {hint}", code=exc.code) from None
            raise

    def contents(self) -> Iterator[Content]:
        """Yield all entries of all objects."""
        for each in self._pages("od_dump"):
            found = _object(each)
            yield from (_content(found, row) for row in each["entries"])

    def _pages(self, method: str) -> Iterator[dict[str, Any]]:
        """Yield the objects of one answer after the other, until the last one."""
        first: int | None = 0
        while first is not None:
            answer = self._request(method, first=first)
            yield from answer["objects"]
            first = answer["next"]

    def _request(self, method: str, **params: Any) -> Any:
        return self._client.request(method, target=self._target, **params)


def _object(row: dict[str, Any]) -> ObjectInfo:
    return ObjectInfo(row["index"], row["name"], row["code"], row["max_subindex"], row["label"])


def _described(row: dict[str, Any]) -> ObjectInfo:
    return replace(_object(row), entries=tuple(_entry(each) for each in row["entries"]))


def _entry(row: dict[str, Any]) -> EntryInfo:
    try:
        kind = datatypes.parse(row["type"])
    except ValueError:
        kind = None  # a later release may know more of them
    return EntryInfo(row["subindex"], row["name"], kind, row["access"], row["unit"])


def _content(found: ObjectInfo, row: dict[str, Any]) -> Content:
    data = row["data"]
    return Content(found, _entry(row), None if data is None else bytes.fromhex(data))
