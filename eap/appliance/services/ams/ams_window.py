"""Window of one AMS/TCP connection: requests under way, their octets and their answers'.

A client that sends ahead of its answers waits in its own connection: packets beyond the window stay
in the kernel, which holds the sender up.
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
_ABOUT_NOTIFICATIONS = frozenset((_ADD, _DELETE))
_READ_WRITE = AmsCommand.READ_WRITE.value
_GROUP = slice(AmsHeader.SIZE, AmsHeader.SIZE + 4)
_SUM_ITEMS = AmsHeader.SIZE + 8
"""Place of the items in the answer to a sum command, behind its result and length."""
_SUM_ADD = IndexGroup.SUM_ADD_NOTIFICATION.value.to_bytes(4, "little")
_SUM_DELETE = IndexGroup.SUM_DELETE_NOTIFICATION.value.to_bytes(4, "little")
_ITEM_SIZES = {_SUM_ADD: 8, _SUM_DELETE: 4}
"""Octets of one item: a result, and a handle where a notification was added."""
_INVOKE_ID = slice(28, 32)
_MAX_SUMS = 256
_NO_ERROR = bytes(4)


class SubscriptionCounter:
    """Notifications of one connection: granted by an answer, and not ended by a later one.

    Attributes:
        count: As above.
    """

    __slots__ = ("_sums", "count")

    def __init__(self) -> None:
        self.count = 0
        self._sums: dict[bytes, bytes] = {}
        """Index groups of the sum commands that wait: their answers do not repeat them."""

    def take_request(self, packet: bytes) -> None:
        """Note a request that came in."""
        group = packet[_GROUP]
        if group in _ITEM_SIZES and packet[_COMMAND] == _READ_WRITE and len(self._sums) < _MAX_SUMS:
            self._sums[packet[:16] + packet[_INVOKE_ID]] = group

    def take_answer(self, packet: bytes) -> None:
        """Note an answer that goes out."""
        command = packet[_COMMAND]
        if command in _ABOUT_NOTIFICATIONS:
            count = int(_is_granted(packet))
            self._add(count if command == _ADD else -count)
        elif command == _READ_WRITE and self._sums:
            key = packet[8:16] + packet[:8] + packet[_INVOKE_ID]
            group = self._sums.pop(key, b"")
            if group and _is_granted(packet):
                starts = range(_SUM_ITEMS, len(packet) - 3, _ITEM_SIZES[group])
                count = sum(packet[at : at + 4] == _NO_ERROR for at in starts)
                self._add(count if group == _SUM_ADD else -count)

    def _add(self, count: int) -> None:
        self.count = max(0, self.count + count)


class AmsWindow:
    """Requests and octets under way on one connection.

    Attributes:
        requests: Number of requests that wait for their answers.
        subscriptions: Notifications of the connection.
    """

    __slots__ = ("_octets", "requests", "subscriptions")

    def __init__(self) -> None:
        self.requests = 0
        self.subscriptions = SubscriptionCounter()
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
            if packet[_GROUP] in _ITEM_SIZES:
                self.subscriptions.take_request(packet)
        return False

    def take_out(self, packet: bytes) -> bool:
        """Note a packet that goes out; return whether it is the answer to one that came in."""
        if not packet[_FLAGS] & _RESPONSE or packet[_COMMAND_GROUP] or not self.requests:
            return False
        # Answers come in any order and do not say how long their requests were; the average does,
        # and nothing is left when all have come.
        self._octets -= self._octets // self.requests
        self.requests -= 1
        self.subscriptions.take_answer(packet)
        return True


def _is_granted(answer: bytes) -> bool:
    return answer[_ERROR] == answer[_RESULT] == _NO_ERROR
