"""How much of one AMS/TCP connection may be under way: requests, their octets and their answers'.

Whoever sends ahead of its answers waits in its own connection: what is not looked at yet stays in
the kernel, which holds the sender up.
"""

from __future__ import annotations

import struct

from eap.codec.ads import IndexGroup
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags

MAX_REQUESTS = 64
"""Requests of one connection that wait for their answers."""
MAX_OCTETS = 256 << 10
"""Of these requests and of the answers that they ask for; one request may have more."""
_COMMAND, _COMMAND_GROUP, _FLAGS = 16, 17, 18
"""Octets of the AMS header: both of the command, the lower one of the state flags."""
_ERROR = slice(24, 28)
_RESULT = slice(AmsHeader.SIZE, AmsHeader.SIZE + 4)
_LENGTH = struct.Struct("<8xI")
_WITHOUT_ANSWER = (StateFlags.RESPONSE | StateFlags.NO_RETURN).value
_RESPONSE = StateFlags.RESPONSE.value
_NOTIFICATION = AmsCommand.NOTIFICATION.value
_READS = frozenset((AmsCommand.READ.value, AmsCommand.READ_WRITE.value))
_ADD, _DELETE = AmsCommand.ADD_NOTIFICATION.value, AmsCommand.DELETE_NOTIFICATION.value
_SUM_ADD = IndexGroup.SUM_ADD_NOTIFICATION.value.to_bytes(4, "little")
_ABOUT_NOTIFICATIONS = frozenset((_ADD, _DELETE))
_NO_ERROR = bytes(4)


class AmsWindow:
    """What is under way.

    Attributes:
        requests: That wait for their answers.
        subscriptions: Notifications that were granted and not ended again; those of a sum command
            count as one, and for good.
    """

    __slots__ = ("_octets", "requests", "subscriptions")

    def __init__(self) -> None:
        self.requests = 0
        self.subscriptions = 0
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
            if packet[AmsHeader.SIZE : AmsHeader.SIZE + 4] == _SUM_ADD:
                self.subscriptions += 1
        return False

    def take_out(self, packet: bytes) -> bool:
        """Note a packet that goes out; return whether it is the answer to one that came in."""
        if not packet[_FLAGS] & _RESPONSE or packet[_COMMAND_GROUP] or not self.requests:
            return False
        # Answers come in any order and do not say how long their requests were; the average does,
        # and nothing is left when all have come.
        self._octets -= self._octets // self.requests
        self.requests -= 1
        command = packet[_COMMAND]
        if command in _ABOUT_NOTIFICATIONS and _is_granted(packet):
            self.subscriptions = max(0, self.subscriptions + (1 if command == _ADD else -1))
        return True


def grants_notification(packet: bytes) -> bool:
    """Say whether a packet that goes out grants a notification to its client."""
    return packet[_COMMAND] == _ADD and bool(packet[_FLAGS] & _RESPONSE) and _is_granted(packet)


def _is_granted(answer: bytes) -> bool:
    return answer[_ERROR] == answer[_RESULT] == _NO_ERROR
