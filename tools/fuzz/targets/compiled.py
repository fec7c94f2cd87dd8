"""Frames and patches for the compiled part: what it writes is the same as without it.

Where it was not built, both sides are Python and nothing can differ.
"""

from __future__ import annotations

import struct

from eap.compiled import cyclic
from eap.ids import InterfaceUri, NetId
from eap.pd.image import Image, format_image
from eap.pd.layout import plan_layout
from eap.pd.link import FrameHandler
from eap.pd.poll import PollRequests
from eap.pd.spec import PortKind, PortSpec, RxPdSpec, StationSpec, VariableSpec, Writer
from eap.pd.subscriber import Subscriber
from eap.pd.words import StationWord

_PDS = (
    ("170.187.204.221.238.255", 1, 0x1234, 8),
    ("170.187.204.221.238.255", 2, 0xABCD, 4),
    ("192.168.0.1.1.1", 1001, 0, 1),
    ("192.168.0.1.1.1", 1002, 7, 5),
    ("192.168.0.1.1.1", 1, 0, 2),
)
"""Publisher, id, version and size of those of the golden vectors."""
_SPEC = StationSpec(
    "fuzzed",
    NetId.parse("5.1.1.1.1.1"),
    1000,
    (
        PortSpec(
            "eap0", PortKind.EAP, InterfaceUri.parse("loop://line"), NetId.parse("5.1.1.1.2.1")
        ),
    ),
    variables=tuple(
        VariableSpec(f"v{n}", f"BLOCK({pd[3]})", Writer.ENGINE) for n, pd in enumerate(_PDS)
    ),
    subscriptions=tuple(
        RxPdSpec(
            f"v{n}", "eap0", pd_id, (f"v{n}",), publisher, version, sender_cycle_us=1000, step=1
        )
        for n, (publisher, pd_id, version, _) in enumerate(_PDS)
    ),
)
_LAYOUT = plan_layout(_SPEC)


class _Origin:
    """A sender with one of two addresses."""

    def __init__(self, number: int) -> None:
        self._address = bytes((10, 0, 0, number))

    def source_of(self, data: memoryview) -> bytes:
        """Return its address."""
        del data
        return self._address

    def sender_of(self, data: memoryview) -> str:
        """Return no destination."""
        del data
        return ""


def _port(*, lenient: bool, compiled: bool) -> tuple[Image, Subscriber, FrameHandler]:
    image = format_image(memoryview(bytearray(_LAYOUT.size)), _LAYOUT, 1)
    subscriber = Subscriber(
        image,
        zip(_SPEC.subscriptions, _LAYOUT.rx, strict=True),
        1_000_000,
        PollRequests(()),
        lenient=lenient,
    )
    handler = subscriber.make_handler() if compiled else subscriber.receive_frame
    subscriber.open(0)
    return image, subscriber, handler


_PAIRS = [
    [_port(lenient=lenient, compiled=each) for each in (True, False)] for lenient in (False, True)
]


_SOURCES = (bytes(range(1, 41)), bytes(range(200, 230)))
"""Image and inputs of a patch."""
_WORDS = memoryview(bytearray(8 * 256)).cast("q")
_FRAME_SIZE = 48
_move = struct.Struct("=4q").pack


def _patch(data: bytes) -> None:
    """Write the bits that *data* names, four octets for each move, into a frame.

    A patch that reaches outside of its memory is refused; any other writes those bits alone.
    """
    if cyclic is None:
        return
    rows = list(zip(*[iter(data)] * 4, strict=False))
    moves = [(row[0] % 3, 2 * row[1] - 20, 2 * row[2] - 20, row[3]) for row in rows]
    frame = bytearray(b"\xa5" * _FRAME_SIZE)
    expected = int.from_bytes(b"\x34\x12" + frame[2:], "little")
    try:
        packed = b"".join(_move(*move) for move in moves)
        patch = cyclic.Patch(frame, 0, _SOURCES, _WORDS, 1000, packed, b"")
    except ValueError:
        return
    patch(0x1234)
    for memory, source, target, bits in moves:
        mask = (1 << bits) - 1
        value = int.from_bytes(_SOURCES[memory], "little") >> source & mask
        expected = expected & ~(mask << target) | value << target
    if frame != expected.to_bytes(_FRAME_SIZE, "little"):
        raise AssertionError(f"a patch of {moves} wrote {frame.hex()}")


def fuzz_one(data: bytes) -> None:
    """Give the frame to both sides twice: the first may be one of an unknown layout."""
    _patch(data[:32])
    pair = _PAIRS[len(data) & 1]
    for _ in range(2):
        for image, _, handle in pair:
            words = image.words
            words[StationWord.CYCLE] += 1
            at_ns = words[StationWord.CYCLE] * (1_000_000 if data[-1:] < b"\xf0" else 70_000)
            octets = memoryview(data + bytes(len(data) & 7))
            handle(octets, len(data), at_ns, _Origin(data[-1] & 1 if data else 0))
        (one, _, _), (other, _, _) = pair
        if bytes(one.memory) != bytes(other.memory):
            raise AssertionError("the image differs from that of the Python code")
