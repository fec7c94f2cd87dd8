"""AoE of a slave: AMS packets, in fragments where the mailbox is too small (ETG.1020).

:class:`AoeServer` carries packets to a handler; :class:`AdsServer` is the handler that serves ADS
out of an object dictionary.
"""

from __future__ import annotations

from collections.abc import Callable

from devicebus.mailbox.protocol import MailboxSizes, raise_mailbox_error
from eap.ads.device import AdsDevice
from eap.ads.notifications import AdsClient
from eap.ads.objects import ObjectSpace
from eap.ams.reassembly import FragmentAssembler, iter_fragments
from eap.codec.ads import (
    AdsDeviceInfo,
    AdsError,
    AdsRange,
    AdsState,
    AdsStates,
    IndexGroup,
    device_name,
    encode_result,
)
from eap.codec.ams import AmsAnswer, AmsCommand, AmsHeader, StateFlags, decode_packet, response_to
from eap.codec.mailbox import MailboxError
from eap.errors import CodecError
from eap.ids import Endpoint, NetId
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdState

_NET_ID_OFFSET = 3
_NET_ID_SIZE = 6
_SERVICES = frozenset((AmsCommand.READ_DEVICE_INFO, AmsCommand.READ_STATE, AmsCommand.READ,
                       AmsCommand.WRITE, AmsCommand.READ_WRITE))  # fmt: skip
# Only notifications belong to a client, and AoE of a slave has none: one client does for all.
_MASTER = AdsClient(Endpoint("", ""), NetId(bytes(_NET_ID_SIZE)), 0)


class AdsServer:
    """ADS services of one slave, without notifications; the handler of an AoeServer.

    Args:
        dictionary: Objects to read and write.
        state: Returns the present state of the slave.
        name: Device name; device info carries its first 15 bytes.

    Attributes:
        address: NetID and port of the slave; None until a request has set them.
    """

    def __init__(
        self, dictionary: ObjectDictionary, state: Callable[[], OdState], name: str
    ) -> None:
        self.address: tuple[NetId, int] | None = None
        self._device = AdsDevice(
            AdsDeviceInfo(1, 0, 0, device_name(name)),
            lambda: AdsStates(AdsState.RUN, 0),
            [ObjectSpace(dictionary, state)],
        )

    def reset_address(self) -> None:
        """Forget the address: the mailbox restarts, the next request sets it."""
        self.address = None

    def __call__(self, header: AmsHeader, data: bytes) -> AmsAnswer:
        """Answer one request."""
        if header.command == AmsCommand.WRITE and self._set_address(header, data):
            return AmsAnswer(encode_result(AdsError.NONE))
        # A slave without a NetID adopts the target of the first request that reaches it.
        if self.address is None:
            self.address = header.target, header.target_port
        if header.target != self.address[0]:
            return AmsAnswer(error_code=AdsError.TARGET_MACHINE)
        if header.target_port != self.address[1]:
            return AmsAnswer(error_code=AdsError.TARGET_PORT)
        if header.command not in _SERVICES:
            return AmsAnswer(error_code=AdsError.SERVICE)
        return self._device.answer(header.command, data, _MASTER, 0)

    def _set_address(self, header: AmsHeader, data: bytes) -> bool:
        if len(data) < AdsRange.SIZE + _NET_ID_SIZE:
            return False
        requested = AdsRange.decode(data)
        location = IndexGroup.ADDRESS, _NET_ID_OFFSET, _NET_ID_SIZE
        if (requested.group, requested.offset, requested.length) != location:
            return False
        octets = data[AdsRange.SIZE : AdsRange.SIZE + _NET_ID_SIZE]
        # A NetID that begins with four zeros takes these four bytes from the target of the write.
        if not any(octets[:4]):
            octets = bytes(header.target)[:4] + octets[4:]
        self.address = NetId(octets), header.target_port
        return True


class AoeServer:
    """AoE protocol of a slave.

    Args:
        handler: Called with header and data of each request; returns None without an answer.
        sizes: Of the slave's mailboxes.
        reset_handler: Called when the mailbox restarts.
    """

    def __init__(
        self,
        handler: Callable[[AmsHeader, bytes], AmsAnswer | None],
        sizes: MailboxSizes,
        *,
        reset_handler: Callable[[], None] | None = None,
    ) -> None:
        self.assembler = FragmentAssembler()
        self._reset_handler = reset_handler
        self._handler = handler
        self._sizes = sizes
        self._number = 0

    def receive_message(self, data: bytes, now_ns: int) -> list[bytes]:
        """Handle a packet (without mailbox header) and return its answers."""
        try:
            header, body = decode_packet(data)
        except CodecError as exc:
            raise_mailbox_error(MailboxError.SIZE_TOO_SHORT, str(exc))
        if header.state_flags & StateFlags.RESPONSE:
            raise_mailbox_error(
                MailboxError.SERVICE_NOT_SUPPORTED, "a response, expected a request"
            )
        if header.command != AmsCommand.FRAGMENT:
            return self._answer(header, bytes(body))
        try:
            packet, acknowledgement = self.assembler.receive(header, bytes(body), now_ns)
        except CodecError as exc:
            raise_mailbox_error(MailboxError.INVALID_SIZE, str(exc))
        if packet is None:
            return [] if acknowledgement is None else [acknowledgement]
        header, body = decode_packet(packet)
        return self._answer(header, bytes(body))

    def messages_to_send(self, now_ns: int) -> list[bytes]:
        """Return nothing: this server only answers."""
        del now_ns
        return []

    def reset(self) -> None:
        """Discard incomplete packets and reset the handler."""
        self.assembler.reset()
        if self._reset_handler is not None:
            self._reset_handler()

    def _answer(self, header: AmsHeader, body: bytes) -> list[bytes]:
        answer = self._handler(header, body)
        if answer is None or header.state_flags & StateFlags.NO_RETURN:
            return []
        packet = response_to(header, answer)
        room = self._sizes.data_to_master - AmsHeader.SIZE
        if len(packet) <= self._sizes.data_to_master or room < 1:
            return [packet]
        # Receivers tell packets apart by this number, the source NetID and the source port.
        self._number += 1
        return list(iter_fragments(packet, self._number, room))
