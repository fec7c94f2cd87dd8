"""Authenticated process data: the last PD of a frame signs all that is before it.

The format is this project's own; it follows what OPC UA PubSub and IEC 62351-6 do for groups: a key
that several stations share, a counter that only rises, and a tag over the frame.  Receivers that do
not know it skip a PD that they have not subscribed to.

The PD has ID 65534 and version 1.  Its data is the key's number (16 bits), 16 reserved bits, the
counter (64 bits: nanoseconds since 1970, raised by one where that would not rise), and the first 16
bytes of HMAC-SHA256 over the frame from its publisher up to the counter.
"""

from __future__ import annotations

import hmac
import struct
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from eap.codec.pd import PD_FRAME_START, PdHeader
from eap.pd.link import ChannelLayer, FrameChannel, OutFrame
from eap.pd.words import PdDropReason

SIGNATURE_ID = 0xFFFE
"""ID of the PD that signs a frame."""
SIGNATURE_VERSION = 1
TAG_SIZE = 16
_HEAD = struct.Struct("<HHQ")
SIGNATURE_SIZE = _HEAD.size + TAG_SIZE
"""Bytes of its data."""
SIGNED_BYTES = PdHeader.SIZE + SIGNATURE_SIZE
"""Bytes by which a signed frame is longer."""
KEY_SIZE = 32
_LARGEST_COUNTER = (1 << 63) - 1
"""Largest counter that fits a word of the image: the year 2262."""


SIGNATURE_FAULTS = (PdDropReason.BAD_TAG, PdDropReason.REPLAYED)
"""Results of a check that is not passed."""


class Keys(NamedTuple):
    """Keys of a group of stations; those without any sign nothing and accept nothing."""

    by_number: Mapping[int, bytes] = {}
    signing: int = 0
    """Number of the key that signs; the others are accepted."""


class KeyRing:
    """The keys of one station, which may change while it runs, and the counter of what it signs.

    Attributes:
        keys: The present keys.
        epoch_offset_ns: Nanoseconds since 1970 minus the monotonic clock.
    """

    def __init__(self, keys: Keys = Keys(), epoch_offset_ns: int = 0) -> None:  # noqa: B008
        self.keys = keys
        self.epoch_offset_ns = epoch_offset_ns
        self._counter = 0

    def sign(self, frame: OutFrame, now_ns: int) -> None:
        """Write the signature of *frame*, whose last PD is one, over what is in it now."""
        number = self.keys.signing
        # Without a key the frame goes all the same, and receivers count it as not authentic.
        key = self.keys.by_number.get(number)
        view = frame.view
        at = frame.headroom + frame.signature
        self._counter = counter = max(self._counter + 1, self.epoch_offset_ns + now_ns)
        _HEAD.pack_into(view, at, number, 0, counter)
        tag = at + _HEAD.size
        start = frame.headroom + PD_FRAME_START
        view[tag : tag + TAG_SIZE] = bytes(TAG_SIZE) if key is None else _tag(key, view[start:tag])

    def counter_of(self, data: memoryview, at: int) -> int | None:
        """Return the counter of a frame whose signature lies at *at*, None if its tag is wrong."""
        number, _, counter = _HEAD.unpack_from(data, at)
        key = self.keys.by_number.get(number)
        if key is None or counter > _LARGEST_COUNTER:
            return None
        tag = at + _HEAD.size
        expected = _tag(key, data[PD_FRAME_START:tag])
        is_right = hmac.compare_digest(expected, data[tag : tag + TAG_SIZE])
        return int(counter) if is_right else None


def _tag(key: bytes, signed: memoryview) -> bytes:
    return hmac.digest(key, signed, "sha256")[:TAG_SIZE]


def find_signature(pds: Sequence[tuple[PdHeader, int]]) -> int | None:
    """Return where the data of a frame's signature begins, None without one.

    *pds* are its PDs, each with the offset of its header.
    """
    if not pds:
        return None
    header, offset = pds[-1]
    return offset + PdHeader.SIZE if is_signature(header) else None


def is_signature(header: PdHeader) -> bool:
    """Return whether a PD is a signature, by its header."""
    found = header.pd_id, header.version, header.length
    return found == (SIGNATURE_ID, SIGNATURE_VERSION, SIGNATURE_SIZE)


class FoundSignature(NamedTuple):
    """Number of the key that a signature names, and its counter."""

    key: int
    counter: int


def read_signature(pd_id: int, version: int, data: bytes) -> FoundSignature | None:
    """Return what the data of a PD says as a signature, None if it is none."""
    if not is_signature(PdHeader(pd_id, version, len(data))):
        return None
    number, _, counter = _HEAD.unpack_from(data)
    return FoundSignature(number, counter)


class SignatureCheck:
    """Check of the signature of one layout of frames, for the subscriptions that want it.

    Args:
        keys: Keys of the station.
        at: Where the signature's data begins in the frame.
        words: Of the image.
        counters: Words with the last counter of each subscription that wants the check.
    """

    def __init__(self, keys: KeyRing, at: int, words: memoryview, counters: Sequence[int]) -> None:
        self._keys = keys
        self._at = at
        self._words = words
        self._counters = counters

    def fault(self, data: memoryview) -> PdDropReason | None:
        """Return what is wrong with a frame, None if it is authentic and new."""
        counter = self._keys.counter_of(data, self._at)
        if counter is None:
            return PdDropReason.BAD_TAG
        words = self._words
        if any(counter <= words[each] for each in self._counters):
            return PdDropReason.REPLAYED
        for each in self._counters:
            words[each] = counter
        return None


class SigningChannel(ChannelLayer):
    """A channel that signs the frames that end with a signature.

    Behind whatever else writes into frames: a change after it would be a wrong tag.
    """

    direct = None

    def __init__(self, channel: FrameChannel, keys: KeyRing) -> None:
        super().__init__(channel)
        self._keys = keys

    def send(self, frames: Sequence[OutFrame], now_ns: int) -> Sequence[OutFrame]:
        """Sign *frames* and send them; return those that could not be sent."""
        for frame in frames:
            if frame.signature:
                self._keys.sign(frame, now_ns)
        return self._channel.send(frames, now_ns)
