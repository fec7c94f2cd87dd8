"""How much of one AMS/TCP connection may be under way: requests, their octets and their answers'.

Whoever sends ahead of its answers waits in its own connection: what is not looked at yet stays in
the kernel, which holds the sender up.
"""

from __future__ import annotations

import struct

from eap.codec.ams import AmsCommand, AmsHeader, StateFlags

MAX_REQUESTS = 64
"""Requests of one connection that wait for their answers."""
MAX_OCTETS = 256 << 10
"""Of these requests and of the answers that they ask for; one request may have more."""
_COMMAND, _COMMAND_GROUP, _FLAGS = 16, 17, 18
"""Octets of the AMS header: both of the command, the lower one of the state flags."""
_LENGTH = struct.Struct("<8xI")
_WITHOUT_ANSWER = (StateFlags.RESPONSE | StateFlags.NO_RETURN).value
_RESPONSE = StateFlags.RESPONSE.value
_NOTIFICATION = AmsCommand.NOTIFICATION.value
_READS = frozenset((AmsCommand.READ.value, AmsCommand.READ_WRITE.value))


class AmsWindow:
    """What is under way.

    Attributes:
        requests: That wait for their answers.
    """

    __slots__ = ("_octets", "requests")

    def __init__(self) -> None:
        self.requests = 0
        self._octets = 0

    @property
    def is_full(self) -> bool:
        """Whether the next request has to wait."""
        return self.requests >= MAX_REQUESTS or self._octets >= MAX_OCTETS

    def take_in(self, packet: bytes) -> bool:
        """Note a packet that came in; return whether it is an answer."""
        flags, command = packet[_FLAGS], packet[_COMMAND]
        # Those with a group of their own are fragments, of which nothing waits for an answer.
        if flags & _WITHOUT_ANSWER or packet[_COMMAND_GROUP] or command == _NOTIFICATION:
            return bool(flags & _RESPONSE)
        size = len(packet)
        self.requests += 1
        self._octets += size
        if command in _READS and size >= AmsHeader.SIZE + _LENGTH.size:
            (asked,) = _LENGTH.unpack_from(packet, AmsHeader.SIZE)
            self._octets += min(MAX_OCTETS, asked)
        return False

    def take_out(self, packet: bytes) -> bool:
        """Note a packet that goes out; return whether it is the answer to one that came in."""
        if not packet[_FLAGS] & _RESPONSE or packet[_COMMAND_GROUP] or not self.requests:
            return False
        # Answers come in any order and do not say how long their requests were; the average does,
        # and nothing is left when all have come.
        self._octets -= self._octets // self.requests
        self.requests -= 1
        return True
