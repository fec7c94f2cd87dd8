"""The object dictionary of a slave behind a bus of a running station, through its CoE mailbox."""

from __future__ import annotations

from collections.abc import Iterator

from devicebus.errors import MailboxProtocolError, MailboxRefusedError
from devicebus.mailbox import coe_client, coeinfo_client
from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from eap.appliance.commands.bus_slave import SlaveBus
from eap.appliance.commands.od_described import entry_info, object_info, read_all, with_entries
from eap.appliance.commands.od_device import Content, EntryInfo, ObjectInfo
from eap.ids import ObjectId
from eap.od.abort import AbortCode, SdoAbortError

_NOT_THERE = {AbortCode.NO_SUBINDEX, AbortCode.NO_OBJECT, AbortCode.NOT_STORED}


class SlaveOd:
    """The objects of one slave.

    Raises:
        SdoAbortError: (every method) the slave refuses.
        BusError: (every method) there is no such slave, or it does not answer.
    """

    def __init__(self, bus: SlaveBus, slave: str) -> None:
        self._bus = bus
        self._slave = bus.find(slave)

    def objects(self) -> list[ObjectInfo]:
        """Return all objects that the slave describes, without their entries."""
        begin = coeinfo_client.object_list
        indexes = self._bus.converse(self._slave, lambda _: begin(), "object list")
        return [self._object(index) for index in indexes]

    def describe(self, index: int) -> ObjectInfo:
        """Return one object with its entries."""
        return with_entries(self, self._object(index))

    def entry(self, index: int, subindex: int) -> EntryInfo | None:
        """Return what the slave says of an entry; None if it says nothing."""
        name = str(ObjectId(index, subindex))
        try:
            found = self._bus.converse(
                self._slave, lambda _: coeinfo_client.entry_description(index, subindex), name
            )
        except (MailboxProtocolError, MailboxRefusedError):
            return None
        except SdoAbortError as exc:
            if exc.code in _NOT_THERE:
                return None
            raise
        return entry_info(subindex, found)

    def read(self, index: int, subindex: int, *, complete: bool = False) -> bytes:
        """Return the octets of an entry or of an object."""
        return self._bus.converse(
            self._slave,
            lambda _: coe_client.upload(index, subindex, complete=complete),
            str(ObjectId(index, subindex)),
        )

    def write(self, index: int, subindex: int, octets: bytes, *, complete: bool = False) -> None:
        """Write an entry or an object."""

        def begin(sizes: MailboxSizes) -> Conversation[None]:
            return coe_client.download(index, subindex, octets, sizes, complete=complete)

        self._bus.converse(self._slave, begin, str(ObjectId(index, subindex)))

    def contents(self) -> Iterator[Content]:
        """Return all entries of all objects, as they come in."""
        return read_all(self, SdoAbortError, MailboxProtocolError)

    def _object(self, index: int) -> ObjectInfo:
        found = self._bus.converse(
            self._slave,
            lambda _: coeinfo_client.object_description(index),
            f"0x{index:04X}",
        )
        return object_info(index, found)
