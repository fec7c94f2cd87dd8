"""Interface to one slave's mailbox: whole operations on objects, elements, files and messages.

Both implementations raise the same errors: SdoAbortError, SoeError and FoeError for a refusal of
the slave with its own code, the BusErrors of the mailbox, EngineGoneError for an own bus that is
not served, and RemoteAccessError for the way to another station.
"""

from __future__ import annotations

from typing import Protocol

from devicebus.mailbox.conversation import MailboxMessage
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.ads import AdsError
from eap.codec.ams import AmsHeader
from eap.codec.coe import SdoInfoOpcode
from eap.codec.mailbox import MailboxType
from eap.errors import EapError
from eap.gateway.error_table import cause_of_result
from eap.services.slaves.file_stream import AHEAD, FileStream
from eap.services.slaves.object_stream import ObjectStream


class RemoteAccessError(EapError):
    """A slave of another station was not reached, or refused without a code of its protocol.

    Attributes:
        result: Error of ADS.
        is_of_way: Whether the slave was not reached; every other error is its own refusal.
    """

    def __init__(self, result: int) -> None:
        super().__init__(AdsError.words_of(result))
        self.result = result
        self.is_of_way = not cause_of_result(result).is_from_slave


class SlaveAccess(Protocol):
    """Access to one slave for one requester; the operations of several requesters take turns.

    Every operation raises the errors that the module's text names.  Cancelling it ends what is
    under way, at the slave too.
    """

    async def sizes(self) -> MailboxSizes:
        """Return the sizes of the slave's mailboxes; raise NoMailboxError if none is open."""

    async def probe(self) -> None:
        """Raise RemoteAccessError if the slave's station does not answer."""

    async def read_object(self, index: int, subindex: int, *, complete: bool = False) -> bytes:
        """Read an entry, or with *complete* an object from subindex 0 or 1 on."""

    async def open_object(
        self, index: int, subindex: int, *, complete: bool = False
    ) -> ObjectStream:
        """Begin to read as :meth:`read_object` does; the stream is closed by the caller."""

    async def write_object(
        self, index: int, subindex: int, data: bytes, *, complete: bool = False
    ) -> None:
        """Write an entry, or with *complete* an object from subindex 0 or 1 on."""

    async def write_unsized(self, index: int, subindex: int, octets: bytes) -> None:
        """Write an entry from four octets of which as many count as the entry has."""

    async def read_info(self, opcode: SdoInfoOpcode, request: bytes) -> bytes:
        """Return the body of an SDO information answer, its fragments joined."""

    async def read_elements(self, idn: int, elements: int, *, drive: int) -> bytes:
        """Read elements of an IDN, one behind the other; lists and texts with their heads."""

    async def write_elements(self, idn: int, elements: int, data: bytes, *, drive: int) -> None:
        """Write an element of an IDN; a list or text with its head."""

    def open_file(
        self, name: str, password: int, *, is_write: bool, ahead: int = AHEAD
    ) -> FileStream:
        """Begin to move a file, *ahead* octets before its reader; it is closed by the caller."""

    async def exchange_vendor(self, message: bytes) -> bytes:
        """Return the answer to a VoE message, both with their VoE headers."""

    async def send_vendor(self, message: bytes) -> None:
        """Send a VoE message that is not answered."""

    async def exchange_ads(self, header: AmsHeader, data: bytes) -> bytes:
        """Return the AMS packet that answers an AoE request; nothing if it wants no answer."""

    async def exchange(
        self, kind: MailboxType, request: bytes, *, expects_reply: bool = True
    ) -> MailboxMessage:
        """Pass a mailbox message that has no operation here, and return its answer."""
