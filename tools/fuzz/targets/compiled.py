"""Frames for the compiled part of the receive path: the image is the same as without it.

Where the compiled part was not built, both sides are Python and nothing can differ.
"""

from __future__ import annotations

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


def fuzz_one(data: bytes) -> None:
    """Give the frame to both sides twice: the first may be one of an unknown layout."""
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
