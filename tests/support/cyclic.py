"""Stations, images and lines in memory for tests of the cyclic core."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from eap.codec.pd import PdFrameHeader, PdHeader, encode_frame
from eap.ids import NetId
from eap.pd.image import Image, format_image
from eap.pd.layout import RxPlace, plan_layout
from eap.pd.link import OutFrame, Taker
from eap.pd.spec import PortKind, PortSpec, RxPdSpec, StationSpec, VariableSpec, Writer
from eap.pd.subscriber import Subscriber
from eap.pd.words import DISCARDS, RxWord, StationWord

PEER = "5.23.91.23.1.1"
"""NetID of the port that publishes in most tests."""
OWN = "5.23.91.24.1.1"
MS = 1_000_000
SECOND = 1_000_000_000


def eap_port(name: str = "eap0", net_id: str = OWN) -> PortSpec:
    return PortSpec(name, PortKind.EAP, "loop://line", net_id)


def received(*variables: str) -> tuple[VariableSpec, ...]:
    """Variables written as ``name:type`` that a subscription fills."""
    return tuple(VariableSpec(*v.split(":", 1), writer=Writer.ENGINE) for v in variables)


def written(*variables: str) -> tuple[VariableSpec, ...]:
    """Variables written as ``name:type`` that the application fills."""
    return tuple(VariableSpec(*v.split(":", 1)) for v in variables)


def station(name: str = "a", *, cycle_us: int = 1000, **parts: object) -> StationSpec:
    """A station with one EAP port, unless *parts* name others."""
    parts.setdefault("ports", (eap_port(),))
    return StationSpec(name, "5.23.91.99.1.1", cycle_us, **parts)


def image_of(spec: StationSpec) -> Image:
    """A fresh process image for *spec* in memory."""
    layout = plan_layout(spec)
    return format_image(memoryview(bytearray(layout.size)), layout, 1)


def octets(
    pds: Iterable[tuple[int, bytes] | tuple[int, bytes, int] | tuple[int, bytes, int, int]],
    *,
    cycle: int = 0,
    publisher: str = PEER,
) -> bytes:
    """A frame of PDs, each (id, data, version, quality)."""
    rows = [(pd[0], pd[1], *pd[2:], *(0, 0)[len(pd) - 2 :]) for pd in pds]
    return encode_frame(
        PdFrameHeader(NetId.parse(publisher), 0, cycle),
        [(PdHeader(i, version, 0, quality), data) for i, data, version, quality in rows],
    )


def give(taker: Taker, frame: bytes, at_ns: int) -> None:
    """Hand *frame* over as a driver does: in a buffer that is longer than it."""
    taker(memoryview(frame + b"\xee" * 32), len(frame), at_ns)


class Receiver:
    """A subscriber in Op and the image that it fills."""

    def __init__(self, *pds: RxPdSpec, variables: Sequence[VariableSpec], cycle_us: int = 1000):
        self.spec = station(cycle_us=cycle_us, variables=tuple(variables), subscriptions=tuple(pds))
        self.image = image_of(self.spec)
        self.start(0)

    def start(self, now_ns: int) -> None:
        """Start as an engine does, also once more on the same image."""
        pairs = zip(self.spec.subscriptions, self.image.layout.rx, strict=True)
        self.subscriber = Subscriber(self.image, list(pairs), self.spec.cycle_us * 1000)
        self.subscriber.open(now_ns)

    def give(self, frame: bytes, at_ns: int) -> None:
        give(self.subscriber.receive_frame, frame, at_ns)

    def place(self, name: str) -> RxPlace:
        return next(place for place in self.image.layout.rx if place.name == name)

    def word(self, name: str, word: RxWord) -> int:
        """A word of the subscription *name*, of its account if it belongs there."""
        place = self.place(name)
        first = place.words
        if word >= RxWord.RECEIVED:
            first = self.image.words[place.words + RxWord.ACCOUNT]
        return self.image.words[first + word]

    def discarded(self, name: str | None = None) -> dict[str, int]:
        """What the station, or one subscription, refused, by reason."""
        first = StationWord.DISCARDED
        if name is not None:
            first = self.place(name).words + RxWord.DISCARDED
        counts = self.image.words[first : first + len(DISCARDS)].tolist()
        return {why.value: count for why, count in zip(DISCARDS, counts, strict=True) if count}


class Wire:
    """A channel whose both ends the test holds.

    Attributes:
        sent: What was sent, as octets, oldest first.
        waiting: What :meth:`drain` will hand over, with times of arrival.
        refuse: Whether the network refuses to send.
    """

    def __init__(self, header: bytes = b"", minimum_size: int = 0) -> None:
        self.minimum_size = minimum_size
        self.sent: list[bytes] = []
        self.waiting: list[tuple[bytes, int]] = []
        self.takers: list[Taker] = []
        self.refuse = False
        self.log: list[str] = []
        self._header = header

    def link_header(self, destination: str) -> bytes:
        del destination
        return self._header

    def drain(self, now_ns: int) -> int:
        self.log.append(f"drain {now_ns}")
        frames, self.waiting = self.waiting, []
        for frame, at_ns in frames:
            for taker in self.takers:
                give(taker, frame, at_ns)
        return len(frames)

    def send(self, frames: Sequence[OutFrame], now_ns: int) -> Sequence[OutFrame]:
        self.log.append(f"send {now_ns}")
        if self.refuse:
            return list(frames)
        self.sent += [bytes(frame.buffer) for frame in frames]
        return ()
