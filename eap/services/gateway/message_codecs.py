"""SoE, VoE, AoE and EoE in front of a slave, for one client: nothing here lasts but fragments.

A request in fragments is collected, and goes to the slave when it is whole.  EoE passes as it is;
the Ethernet frames of a slave name no client, so all that talk EoE to it get them, as the master
that they stand for would.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from time import monotonic_ns
from typing import NamedTuple

from devicebus.errors import SoeError
from devicebus.mailbox.protocol import MailboxSizes
from eap.ams.reassembly import FragmentAssembler, iter_fragments
from eap.codec.ads import AdsError
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags, decode_packet
from eap.codec.eoe import READS as EOE_READS
from eap.codec.eoe import REQUESTS as EOE_REQUESTS
from eap.codec.mailbox import MailboxType
from eap.codec.soe import SoeHeader, SoeOpcode, encode_fragments
from eap.gateway.error_table import Cause
from eap.gateway.request_tracker import MemoryShare
from eap.gateway.requests import GatewayError
from eap.ids import Endpoint
from eap.services.gateway.sessions import SessionCodec
from eap.services.gateway.transfer_codecs import FileCodec, ObjectCodec
from eap.services.slaves.access import RemoteAccessError, SlaveAccess

_INCOMPLETE = 0x08
LISTENS_NS = 60_000_000_000
"""For how long after its last message a client hears a slave."""
MAX_LISTENERS = 8
"""Of one slave."""
MAX_WRITTEN = 0x10004
"""Octets of the longest list of SoE that is written in fragments."""
_TYPE = 0x0F
_UNKNOWN_GROUP = frozenset((AdsError.INDEX_GROUP, AdsError.SERVICE))
"""Results of a station without EoE in its ADS services."""


class MessageCodec:
    """A request and its answer; base of those without transfers, and a SessionCodec.

    Args:
        access: The slave.
        sizes: Of the mailboxes that the client writes to and reads from.
        memory: For fragments.
    """

    def __init__(self, access: SlaveAccess, sizes: MailboxSizes, memory: MemoryShare) -> None:
        self.sizes = sizes
        self._access = access
        self._memory = memory

    @property
    def is_running(self) -> bool:
        """True if fragments are to come."""
        return False

    def is_step(self, body: bytes) -> bool:
        """Return that no request is known to be repeated."""
        del body
        return False

    def completes_write(self, body: bytes) -> bool:
        """Return that no request stands for many."""
        del body
        return False

    def reset(self) -> None:
        """Forget fragments."""
        self._memory.hold(0)


class ElementCodec(MessageCodec):
    """IDNs of one client."""

    def __init__(self, access: SlaveAccess, sizes: MailboxSizes, memory: MemoryShare) -> None:
        super().__init__(access, sizes, memory)
        self._written = bytearray()

    @property
    def is_running(self) -> bool:
        """True if fragments of a write are to come."""
        return bool(self._written)

    def completes_write(self, body: bytes) -> bool:
        """Return whether a request is the last fragment of a write."""
        return self.is_running and bool(body) and not body[0] & _INCOMPLETE

    def reset(self) -> None:
        """Forget fragments."""
        super().reset()
        self._written.clear()

    async def answer(self, body: bytes) -> list[bytes]:
        """Return the answers to a message; fragments before the last one have none."""
        head, data = SoeHeader.decode(body), body[SoeHeader.SIZE :]
        error, answer = False, b""
        try:
            match head.opcode:
                case SoeOpcode.READ_REQUEST:
                    opcode = SoeOpcode.READ_RESPONSE
                    answer = await self._access.read_elements(
                        head.idn, head.elements, drive=head.drive
                    )
                case SoeOpcode.WRITE_REQUEST:
                    opcode = SoeOpcode.WRITE_RESPONSE
                    self._take(data)
                    # Only the last fragment of a write is answered.
                    if head.incomplete:
                        return []
                    written = bytes(self._written)
                    self.reset()
                    await self._access.write_elements(
                        head.idn, head.elements, written, drive=head.drive
                    )
                case _:
                    raise GatewayError(Cause.SERVICE)
        except SoeError as exc:
            error, answer = True, exc.code.to_bytes(2, "little")
        back = SoeHeader(opcode, 0, error, head.drive, head.elements, head.idn)
        return encode_fragments(back, answer, self.sizes.data_to_master - SoeHeader.SIZE)

    def _take(self, data: bytes) -> None:
        # Collected first: a client that pauses between fragments does not block the slave.
        self._written += data
        if len(self._written) > MAX_WRITTEN:
            raise GatewayError(Cause.TOO_LONG)
        if not self._memory.hold(len(self._written)):
            raise GatewayError(Cause.CROWDED)


class VendorCodec(MessageCodec):
    """VoE messages of one client."""

    async def answer(self, body: bytes) -> list[bytes]:
        """Return the answer to a message."""
        return [await self._access.exchange_vendor(body)]


class AdsCodec(MessageCodec):
    """AMS packets of one client."""

    def __init__(self, access: SlaveAccess, sizes: MailboxSizes, memory: MemoryShare) -> None:
        super().__init__(access, sizes, memory)
        self._assembler = FragmentAssembler()
        self._number = 0

    @property
    def is_running(self) -> bool:
        """True if fragments of a request are to come."""
        return self._assembler.octets > 0

    def reset(self) -> None:
        """Forget fragments."""
        super().reset()
        self._assembler.reset()

    async def answer(self, body: bytes) -> list[bytes]:
        """Return the answers to a packet, or to a fragment of one."""
        header, data = decode_packet(body)
        if header.state_flags & StateFlags.RESPONSE:
            return []  # it acknowledges a fragment that wants no acknowledgement
        if header.command == AmsCommand.FRAGMENT:
            whole, acknowledgement = self._assembler.receive(header, bytes(data), monotonic_ns())
            if not self._memory.hold(self._assembler.octets):
                raise GatewayError(Cause.CROWDED)
            if whole is None:
                return [acknowledgement] if acknowledgement else []
            header, data = decode_packet(whole)
        packet = await self._access.exchange_ads(header, bytes(data))
        max_size = self.sizes.data_to_master
        if len(packet) <= max_size:
            return [packet] if packet else []
        # The packet number is the gateway's own: the slave's fragments were joined before.
        self._number += 1
        return list(iter_fragments(packet, self._number, max_size - AmsHeader.SIZE))


class EthernetCodec(MessageCodec):
    """EoE messages of one client, passed as they are."""

    async def answer(self, body: bytes) -> list[bytes]:
        """Return the answer to a setting; an Ethernet frame has none."""
        # What is too short to say what it is gets the slave's mailbox error.
        expects_reply = not body or body[0] & 0x0F in EOE_REQUESTS
        try:
            message = await self._access.exchange(
                MailboxType.EOE, body, expects_reply=expects_reply
            )
        except RemoteAccessError as exc:
            if exc.result in _UNKNOWN_GROUP:
                raise GatewayError(Cause.NO_PROTOCOL) from None
            raise
        return [message.data] if expects_reply else []


def begins_to_listen(body: bytes) -> bool:
    """Return whether the sender of an EoE message gets the frames of the slave from now on.

    Settings may be read by everybody, the traffic of others may not.
    """
    return bool(body) and body[0] & _TYPE not in EOE_READS


class EoeListener(NamedTuple):
    """A client that talks EoE to a slave."""

    address: int
    """By which it calls the slave."""
    send: Callable[[bytes], None]
    until_ns: int


class EoeListeners:
    """The listeners of all slaves of a bus."""

    def __init__(self) -> None:
        self._by_station: dict[int, OrderedDict[Endpoint, EoeListener]] = {}

    def add(
        self,
        station: int,
        endpoint: Endpoint,
        address: int,
        send: Callable[[bytes], None],
        now_ns: int,
    ) -> None:
        """Note that a client talks to a slave; the one that did so least lately makes room."""
        of_slave = self._by_station.setdefault(station, OrderedDict())
        of_slave[endpoint] = EoeListener(address, send, now_ns + LISTENS_NS)
        of_slave.move_to_end(endpoint)
        # EoE names no client, so each listener gets a copy of every frame of the slave.
        if len(of_slave) > MAX_LISTENERS:
            of_slave.popitem(last=False)

    def of_slave(self, station: int, now_ns: int) -> list[EoeListener]:
        """Return the clients that receive the frames of a slave now."""
        of_slave = self._by_station.get(station)
        if of_slave is None:
            return []
        for endpoint in [
            endpoint for endpoint, each in of_slave.items() if each.until_ns <= now_ns
        ]:
            del of_slave[endpoint]
        return [*of_slave.values()]

    def forget(self, endpoint: Endpoint) -> None:
        """Forget a client whose connection is closed."""
        for of_slave in self._by_station.values():
            of_slave.pop(endpoint, None)


def codec_for(
    kind: MailboxType,
    access: SlaveAccess,
    sizes: MailboxSizes,
    memory: MemoryShare,
    *,
    wait_s: float,
) -> SessionCodec:
    """Return the server's side of a protocol for one client; *wait_s* as FileCodec has it."""
    match kind:
        case MailboxType.COE:
            return ObjectCodec(access, sizes, memory)
        case MailboxType.FOE:
            return FileCodec(access, sizes, memory, wait_s)
        case MailboxType.SOE:
            return ElementCodec(access, sizes, memory)
        case MailboxType.VOE:
            return VendorCodec(access, sizes, memory)
        case MailboxType.AOE:
            return AdsCodec(access, sizes, memory)
        case MailboxType.EOE:
            return EthernetCodec(access, sizes, memory)
        case MailboxType.ERR:
            raise GatewayError(Cause.NO_PROTOCOL)
