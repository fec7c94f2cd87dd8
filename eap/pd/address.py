"""Addresses at run time: destinations and sources as words of the image, learned and watched.

A word is the kind, then a MAC address, or an IPv4 address and the port.  A :class:`NetIdLearner`
learns the MAC address behind a NetID from the frames of the port that has it.  A
:class:`SourceWatch` notes the addresses that the frames of one publisher come from: a publisher ID
is no proof of identity, as any host can put it into a frame.  Where the publisher's address is
configured, frames from all other addresses are distinguished by it.  Where it is not, two hosts
that send with one publisher ID are recognized because the source address alternates.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable
from ipaddress import IPv4Address

from eap.codec.ethercat import FrameType
from eap.ids import Destination, DestinationKind, MacAddr, NetId
from eap.pd.link import FrameHandler, FrameOrigin
from eap.pd.words import RxWord

_KIND_SHIFT = 48
_KINDS = {DestinationKind.MAC: 1, DestinationKind.IP: 2, DestinationKind.TCP: 3}
_BY_NUMBER = {number: kind for kind, number in _KINDS.items()}
_MAC_SIZE = 6
_LOW = (1 << _KIND_SHIFT) - 1


def to_word(destination: str) -> int:
    """Return *destination* as a word, 0 for one that is no address of a network."""
    try:
        kind, host, port = Destination.parse(destination)
    except ValueError:
        return 0
    if kind not in _KINDS:
        return 0
    if kind is DestinationKind.MAC:
        address = int.from_bytes(MacAddr.parse(host))
    else:
        address = int(IPv4Address(host)) << 16 | port
    return _KINDS[kind] << _KIND_SHIFT | address


def source_word(source: bytes) -> int:
    """Return the address that a frame came from as a word: MAC or IPv4, 0 for none."""
    if len(source) == _MAC_SIZE:
        return _KINDS[DestinationKind.MAC] << _KIND_SHIFT | int.from_bytes(source)
    if not source:
        return 0
    # The port stays 0: a restarted publisher may send from another one and is still the same host.
    return _KINDS[DestinationKind.IP] << _KIND_SHIFT | int.from_bytes(source) << 16


def source_text(word: int) -> str | None:
    """Return the address that :func:`source_word` made a word of, None for 0."""
    where = from_word(word)
    return None if where is None else where.host


def source_octets(text: str) -> bytes:
    """Return the address *text*, a MAC or an IPv4 address, as origins of frames give it.

    Raises:
        ValueError: it is neither.
    """
    return MacAddr.parse(text) if ":" in text or "-" in text else IPv4Address(text).packed


def is_group_source(source: bytes) -> bool:
    """Return whether *source* is a multicast or broadcast address, which no sender has."""
    if len(source) == _MAC_SIZE:
        return MacAddr(source).is_group
    address = IPv4Address(source)
    return address.is_multicast or address == IPv4Address(0xFFFFFFFF)


def address_text(source: bytes) -> str:
    """Return the source address of a frame in text form."""
    return str(MacAddr(source)) if len(source) == _MAC_SIZE else str(IPv4Address(source))


def from_word(word: int) -> Destination | None:
    """Return the destination that :func:`to_word` encoded, None for 0."""
    kind = _BY_NUMBER.get(word >> _KIND_SHIFT)
    if kind is None:
        return None
    address = word & _LOW
    if kind is DestinationKind.MAC:
        return Destination(kind, str(MacAddr(address.to_bytes(6))))
    return Destination(kind, str(IPv4Address(address >> 16)), address & 0xFFFF)


def net_id_of(destination: str) -> NetId | None:
    """Return *destination* as a NetID, None if it is another kind of address."""
    try:
        kind, host, _ = Destination.parse(destination)
    except ValueError:
        return None
    return NetId.parse(host) if kind is DestinationKind.NET_ID else None


ALTERNATION_NS = 10_000_000_000
"""Two changes of the address within this time are two senders; a single one is a new address."""
_NEVER = -ALTERNATION_NS


class SourceWatch:
    """The source addresses of one publisher's frames, of one class.

    The addresses that subscriptions of the port expect are a class each, all others one together.

    Args:
        words: Of the process image.
        expected: The address that is this class; empty for all that are not expected.
        named: The addresses that subscriptions expect.

    Attributes:
        source: The address of the last frame.
    """

    __slots__ = (
        "_accepting",
        "_changed_at_ns",
        "_dropping",
        "_expected",
        "_named",
        "_words",
        "source",
    )

    def __init__(self, words: memoryview, expected: bytes, named: frozenset[bytes]) -> None:
        self.source: bytes | None = None
        self._words = words
        self._expected = expected
        self._named = named
        self._accepting: set[int] = set()
        self._dropping: set[int] = set()
        self._changed_at_ns = _NEVER

    def follow(self, accepting: Iterable[int], dropping: Iterable[int]) -> None:
        """Note addresses for more RxPDs too, given by their first words.

        Args:
            accepting: Those that accept PDs of these frames.
            dropping: Those that drop PDs because of the source of these frames.
        """
        self._accepting.update(accepting)
        self._dropping.update(dropping)
        # The address is noted when it changes; a new RxPD would wait for the next change.
        if self.source is not None:
            self._note(source_word(self.source))

    def includes(self, source: bytes, at_ns: int) -> bool:
        """Return whether a frame from *source* is of this class, and note it if the address is new.

        Only called for another address than :attr:`source`.
        """
        if (source if source in self._named else b"") != self._expected:
            return False
        before, self.source = self.source, source
        self._note(source_word(source))
        if before is not None:
            # A single change is a new address of one sender; two in a short time are two senders.
            if at_ns - self._changed_at_ns < ALTERNATION_NS:
                other = source_word(before)
                for first in self._accepting:
                    self._words[first + RxWord.OTHER_SOURCE] = other
                    self._words[first + RxWord.OTHER_SOURCE_AT_NS] = at_ns
            self._changed_at_ns = at_ns
        return True

    def _note(self, word: int) -> None:
        for first in self._accepting:
            self._words[first + RxWord.SOURCE] = word
        for first in self._dropping:
            self._words[first + RxWord.WRONG_SOURCE] = word


LOOK_NS = 100_000_000
"""Interval between two looks at the sender of one NetID's frames: addresses change rarely."""
_PUBLISHER = slice(2, 8)


class NetIdLearner:
    """Looks at the frames of a port on their way to *handler*.

    Attributes:
        wanted: The NetIDs whose address is wanted; it may change at any time.
        learn: Called with such a NetID and the address that its frames come from.
    """

    def __init__(self, handler: FrameHandler) -> None:
        self.wanted: Container[bytes] = ()
        self.learn: Callable[[bytes, str], None] = forget
        self._handler = handler
        self._looked_at_ns: dict[bytes, int] = {}

    def handle(self, data: memoryview, size: int, at_ns: int, origin: FrameOrigin) -> None:
        """Note the sender of a frame, and hand the frame over."""
        # `wanted` comes first: it is empty unless a frame goes to a NetID, and this runs for each
        # frame.
        if self.wanted and size >= _PUBLISHER.stop and data[1] >> 4 == FrameType.PROCESS_DATA:
            publisher = bytes(data[_PUBLISHER])
            if publisher in self.wanted:
                self._look(publisher, data, at_ns, origin)
        self._handler(data, size, at_ns, origin)

    def _look(self, publisher: bytes, data: memoryview, at_ns: int, origin: FrameOrigin) -> None:
        looked_at_ns = self._looked_at_ns.get(publisher)
        # A negative age means that the time stamps went back, as they do when the wall clock is
        # set.
        if looked_at_ns is None or not 0 <= at_ns - looked_at_ns < LOOK_NS:
            self._looked_at_ns[publisher] = at_ns
            if sender := origin.sender_of(data):
                self.learn(publisher, sender)


def forget(net_id: bytes, sender: str) -> None:
    """Ignore a learned address: the port has no publisher."""
    del net_id, sender
