"""Stations, images and lines in memory for tests of the cyclic core."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from eap.codec.pd import PdFrameHeader, PdHeader, encode_frame
from eap.ids import InterfaceUri, NetId
from eap.pd.authentication import KeyRing
from eap.pd.copyplan import CopyPlan, Move
from eap.pd.image import Image, format_image
from eap.pd.layout import RxSlot, VariableSlot, plan_layout
from eap.pd.link import FrameHandler, OutFrame
from eap.pd.poll import PollRequests
from eap.pd.spec import (
    BusEntrySpec,
    BusPortSpec,
    BusSlaveSpec,
    PortKind,
    PortSpec,
    RxPdSpec,
    StationSpec,
    VariableSpec,
    Writer,
)
from eap.pd.station import Station
from eap.pd.subscriber import NO_KEYS, Subscriber
from eap.pd.words import PD_DROP_REASONS, RxWord, StationWord

PEER = "5.23.91.23.1.1"
"""NetID of the port that publishes in most tests."""
OWN = "5.23.91.24.1.1"
MS = 1_000_000
SECOND = 1_000_000_000


def eap_port(name: str = "eap0", net_id: str = OWN) -> PortSpec:
    return PortSpec(name, PortKind.EAP, InterfaceUri.parse("loop://line"), NetId.parse(net_id))


def received(*variables: str) -> tuple[VariableSpec, ...]:
    """Variables written as ``name:type`` that a subscription fills."""
    return tuple(VariableSpec(*v.split(":", 1), writer=Writer.ENGINE) for v in variables)


def written(*variables: str) -> tuple[VariableSpec, ...]:
    """Variables written as ``name:type`` that the application fills."""
    return tuple(VariableSpec(*v.split(":", 1)) for v in variables)


def station(name: str = "a", *, cycle_us: int = 1000, **parts: object) -> StationSpec:
    """A station with one EAP port, unless *parts* name others."""
    parts.setdefault("ports", (eap_port(),))
    return StationSpec(name, NetId.parse("5.23.91.99.1.1"), cycle_us, **parts)


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


class From:
    """An origin whose frames all come from one sender."""

    def __init__(self, sender: str = "somebody", source: bytes = b"") -> None:
        self._sender = sender
        self._source = source

    def source_of(self, data: memoryview) -> bytes:
        del data
        return self._source

    def sender_of(self, data: memoryview) -> str:
        del data
        return self._sender


def give(
    handler: FrameHandler, frame: bytes, at_ns: int, sender: str = "somebody", source: bytes = b""
) -> None:
    """Hand *frame* over as a driver does: in a buffer that is longer than it."""
    handler(memoryview(frame + b"\xee" * 32), len(frame), at_ns, From(sender, source))


class Receiver:
    """A subscriber in Op and the image that it fills."""

    def __init__(
        self,
        *pds: RxPdSpec,
        variables: Sequence[VariableSpec],
        cycle_us: int = 1000,
        lenient: bool = False,
        keys: KeyRing = NO_KEYS,
    ):
        self.lenient = lenient
        self.keys = keys
        self.spec = station(cycle_us=cycle_us, variables=tuple(variables), subscriptions=tuple(pds))
        self.image = image_of(self.spec)
        self.start(0)

    def start(self, now_ns: int) -> None:
        """Start as an engine does, also once more on the same image."""
        pairs = zip(self.spec.subscriptions, self.image.layout.rx, strict=True)
        self.subscriber = Subscriber(
            self.image,
            list(pairs),
            self.spec.cycle_us * 1000,
            PollRequests(()),
            lenient=self.lenient,
            keys=self.keys,
        )
        self.handle = self.subscriber.make_handler()
        self.subscriber.open(now_ns)

    def give(self, frame: bytes, at_ns: int, source: bytes = b"") -> None:
        give(self.handle, frame, at_ns, source=source)

    def slot(self, name: str) -> RxSlot:
        return next(slot for slot in self.image.layout.rx if slot.name == name)

    def word(self, name: str, word: RxWord) -> int:
        """A word of the subscription *name*, of its account if it belongs there."""
        slot = self.slot(name)
        first = slot.words
        if word >= RxWord.RECEIVED:
            first = self.image.words[slot.words + RxWord.TRACKER]
        return self.image.words[first + word]

    def discarded(self, name: str | None = None) -> dict[str, int]:
        """Counters of PDs that the station, or one subscription, refused, by reason."""
        first = StationWord.DISCARDED
        if name is not None:
            first = self.slot(name).words + RxWord.DISCARDED
        counts = self.image.words[first : first + len(PD_DROP_REASONS)].tolist()
        return {
            why.value: count for why, count in zip(PD_DROP_REASONS, counts, strict=True) if count
        }


class Wire:
    """A channel whose both ends the test holds.

    Attributes:
        sent: What was sent, as octets, oldest first.
        waiting: What :meth:`drain` will hand over, with times of arrival.
        refuse: Whether the network refuses to send.
    """

    direct = None

    def __init__(self, header: bytes = b"", minimum_size: int = 0) -> None:
        self.minimum_size = minimum_size
        self.sent: list[bytes] = []
        self.waiting: list[tuple[bytes, int]] = []
        self.handlers: list[FrameHandler] = []
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
            for handler in self.handlers:
                give(handler, frame, at_ns)
        return len(frames)

    def send(self, frames: Sequence[OutFrame], now_ns: int) -> Sequence[OutFrame]:
        self.log.append(f"send {now_ns}")
        if self.refuse:
            return list(frames)
        self.sent += [bytes(frame.buffer) for frame in frames]
        return ()


def entries(*variables: str) -> tuple[BusEntrySpec, ...]:
    """Process data of a slave, written as ``name:bits``; no name it is padding."""
    rows = (variable.rsplit(":", 1) for variable in variables)
    return tuple(BusEntrySpec(name, 0x6000, 1, int(bits)) for name, bits in rows)


def bus_port(*slaves: BusSlaveSpec, name: str = "bus0") -> PortSpec:
    bus = BusPortSpec(slaves=slaves)
    return PortSpec(
        name, PortKind.BUS, InterfaceUri.parse("sim://bus.yaml"), NetId.parse(OWN), bus=bus
    )


def slave(
    inputs: Sequence[BusEntrySpec] = (), outputs: Sequence[BusEntrySpec] = (), station: int = 1001
) -> BusSlaveSpec:
    return BusSlaveSpec(f"slave{station}", station, 2, 3, outputs=outputs, inputs=inputs)


class FakeBus:
    """The bus of one station (or *only* its n-th), whose slaves the test holds.

    An exchange samples the inputs and brings the outputs; what it brought is taken when it is
    *received*.

    Attributes:
        inputs: What the slaves measure.
        outputs: What they have been told.
        due_ns: What :meth:`next_timeout` returns.
        log: Calls, with the time if they are told one.
    """

    def __init__(self, made: Station, *, only: int = 0, log: list[str] | None = None) -> None:
        slots = made.image.slots
        slaves = [port.bus for port in made.spec.ports if port.bus][only].slaves
        self._image = made.image
        self._inputs, input_size = _plan([each.inputs for each in slaves], slots)
        self._outputs, output_size = _plan([each.outputs for each in slaves], slots)
        self._memory_of = made.memory_of
        self.inputs = bytearray(input_size)
        self.outputs = bytearray(output_size)
        self._on_the_way: bytes | None = None
        self._arrived = bytes(input_size)
        self.due_ns: int | None = None
        self.log: list[str] = [] if log is None else log

    def copy_inputs(self) -> None:
        changing = self._image.words[StationWord.ENGINE_SEQUENCE] % 2
        self.log.append("take changing" if changing else "take calm")
        for moves in self._inputs.values():
            CopyPlan(moves).run(self._arrived, self._image.memory)

    def exchange(self, now_ns: int) -> None:
        self.log.append(f"exchange {now_ns}")
        for writer, moves in self._outputs.items():
            back = [(move.target_bit, move.source_bit, move.bits) for move in moves]
            CopyPlan(back).run(self._memory_of(writer), memoryview(self.outputs))
        self._on_the_way = bytes(self.inputs)

    def next_timeout(self) -> int | None:
        return self.due_ns

    def handle_timeout(self, now_ns: int) -> None:
        self.log.append(f"timeout {now_ns}")
        self.due_ns = None

    def receive(self, now_ns: int) -> None:
        self.log.append(f"receive {now_ns}")
        if self._on_the_way is not None:
            self._arrived, self._on_the_way = self._on_the_way, None


def _plan(
    sides: Iterable[Sequence[BusEntrySpec]], slots: Mapping[str, VariableSlot]
) -> tuple[dict[Writer, list[Move]], int]:
    """Moves to the image by writer, and the octets of all sides one behind the other."""
    moves: dict[Writer, list[Move]] = {}
    start = 0
    for side in sides:
        bit = 8 * start
        for entry in side:
            if entry.variable:
                slot = slots[entry.variable]
                move = Move(bit, slot.bit_offset, entry.bit_length)
                moves.setdefault(slot.writer, []).append(move)
            bit += entry.bit_length
        start = -(-bit // 8)
    return moves, start
