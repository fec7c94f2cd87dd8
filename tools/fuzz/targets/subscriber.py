"""Frames as a station's port takes them: no exception at all, and nothing uncounted."""

from __future__ import annotations

from eap.pd.image import format_image
from eap.pd.layout import plan_layout
from eap.pd.poll import Requests
from eap.pd.spec import PortKind, PortSpec, RxPdSpec, StationSpec, VariableSpec, Writer
from eap.pd.subscriber import Subscriber
from eap.pd.words import DISCARDS, RxWord, StationWord

_SIZES = {1: 1, 2: 2, 0x03E9: 1, 0x1234: 4}
"""PDs to subscribe to, those of the golden vectors among them, and their octets."""
_NAMES = [f"v{pd_id}" for pd_id in _SIZES]
_SPEC = StationSpec(
    "fuzzed",
    "5.1.1.1.1.1",
    1000,
    (PortSpec("eap0", PortKind.EAP, "loop://line", "5.1.1.1.2.1"),),
    variables=tuple(
        VariableSpec(name, f"BLOCK({size})", Writer.ENGINE)
        for name, size in zip(_NAMES, _SIZES.values(), strict=True)
    ),
    subscriptions=tuple(
        RxPdSpec(name, "eap0", pd_id, (name,), sender_cycle_us=1000, step=1)
        for name, pd_id in zip(_NAMES, _SIZES, strict=True)
    ),
)
_LAYOUT = plan_layout(_SPEC)
_IMAGE = format_image(memoryview(bytearray(_LAYOUT.size)), _LAYOUT, 1)
_REQUESTS = Requests(_NAMES[:1])
_SUBSCRIBER = Subscriber(
    _IMAGE, zip(_SPEC.subscriptions, _LAYOUT.rx, strict=True), 1_000_000, _REQUESTS
)
_SUBSCRIBER.open(0)


class _Somebody:
    """The sender of every frame."""

    def sender_of(self, data: memoryview) -> str:
        """Return a destination for answers."""
        del data
        return "somebody"


def fuzz_one(data: bytes) -> None:
    """Take the frame at a time that its own octets give."""
    before = _counted()
    at_ns = len(data) * 300_000
    _SUBSCRIBER.receive_frame(memoryview(data + bytes(16)), len(data), at_ns, _Somebody())
    _REQUESTS.take()
    if _IMAGE.words[StationWord.ENGINE_SEQUENCE] % 2:
        raise AssertionError("the engine's region stayed marked as changing")
    carries_none = len(data) >= 14 and data[8:10] == b"\0\0"
    if _counted() == before and not carries_none:
        raise AssertionError("neither taken nor counted")


def _counted() -> int:
    words = _IMAGE.words
    total = sum(words[StationWord.DISCARDED : StationWord.DISCARDED + len(DISCARDS)])
    for place in _LAYOUT.rx:
        first = words[place.words + RxWord.ACCOUNT]
        total += words[first + RxWord.RECEIVED] + words[first + RxWord.REORDERED]
    return total
