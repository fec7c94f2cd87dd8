"""ADS notifications: requests of clients, and the packets with samples.

Beckhoff ADS specification, AddDeviceNotification and DeviceNotification.  A packet holds stamps, a
stamp the samples that were taken at one time.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum
from typing import NamedTuple

from eap.codec.wire import Buffer, WireStruct, octets16, u32, u64
from eap.errors import MalformedError, TruncatedError

_EPOCH = 116_444_736_000_000_000
"""1970-01-01 in units of 100 ns since 1601-01-01."""
UNIT_NS = 100
"""Of delays, cycle times and time stamps."""


class TransMode(IntEnum):
    """ADSTRANSMODE of AdsDef.h: when a sample is sent."""

    NONE = 0
    CLIENT_CYCLE = 1
    CLIENT_ON_CHANGE = 2
    SERVER_CYCLE = 3
    SERVER_ON_CHANGE = 4
    SERVER_CYCLE_2 = 5
    """As 3, in the cycle of the task that the value belongs to (TwinCAT: CyclicInContext)."""
    SERVER_ON_CHANGE_2 = 6
    """As 4, in the cycle of the task that the value belongs to (TwinCAT: OnChangeInContext)."""
    CLIENT_1_REQUEST = 10


class AddNotification(WireStruct, frozen=True):
    """Request of AddDeviceNotification; *length* in bytes, *max_delay* and *cycle* in 100 ns."""

    group: u32
    offset: u32
    length: u32
    mode: u32
    max_delay: u32
    cycle: u32
    reserved: octets16 = bytes(16)


class _PacketHead(WireStruct, frozen=True):
    """*length* counts the bytes behind it."""

    length: u32
    stamps: u32


class _StampHead(WireStruct, frozen=True):
    time: u64
    samples: u32


class _SampleHead(WireStruct, frozen=True):
    handle: u32
    size: u32


class NotificationSample(NamedTuple):
    """One value of one notification."""

    handle: int
    data: bytes

    @property
    def size(self) -> int:
        """Bytes in a packet."""
        return _SampleHead.SIZE + len(self.data)


class Stamp(NamedTuple):
    """Samples taken at one time, in 100 ns since 1601 (FILETIME)."""

    time: int
    samples: tuple[NotificationSample, ...]


def to_filetime(unix_ns: int) -> int:
    """Return nanoseconds since 1970 as the FILETIME of a stamp."""
    return _EPOCH + unix_ns // UNIT_NS


def encode_notification(stamps: Iterable[Stamp]) -> bytes:
    """Return the data of a DeviceNotification."""
    octets = bytearray()
    count = 0
    for stamp in stamps:
        count += 1
        octets += _StampHead(stamp.time, len(stamp.samples)).encode()
        for handle, data in stamp.samples:
            octets += _SampleHead(handle, len(data)).encode()
            octets += data
    # The length counts the bytes behind it: the number of stamps (4 bytes) and the stamps.
    return _PacketHead(len(octets) + 4, count).encode() + octets


def decode_notification(data: Buffer) -> list[Stamp]:
    """Return the stamps of a DeviceNotification.

    Raises:
        TruncatedError: it ends before what its counts say.
        MalformedError: there is more than they say.
    """
    head = _PacketHead.decode(data)
    at = _PacketHead.SIZE
    stamps = []
    for _ in range(head.stamps):
        stamp = _StampHead.decode(data, at)
        at += _StampHead.SIZE
        samples = []
        for _ in range(stamp.samples):
            sample, at = _decode_sample(data, at)
            samples.append(sample)
        stamps.append(Stamp(stamp.time, tuple(samples)))
    # Its length is not looked at: servers disagree on whether it counts itself.
    if at != len(data):
        raise MalformedError(
            f"{len(data)} bytes, but the samples end at {at}", layout="DeviceNotification"
        )
    return stamps


def _decode_sample(data: Buffer, at: int) -> tuple[NotificationSample, int]:
    head = _SampleHead.decode(data, at)
    start = at + _SampleHead.SIZE
    octets = bytes(data[start : start + head.size])
    if len(octets) < head.size:
        raise TruncatedError(
            f"sample of {head.size} bytes, but {len(octets)} follow",
            layout="DeviceNotification",
            offset=at,
        )
    return NotificationSample(head.handle, octets), start + head.size
