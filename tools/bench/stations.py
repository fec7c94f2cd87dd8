"""The stations that the benchmarks run: one that publishes, one that subscribes to all of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import msgspec

from eap.codec.ethercat import ETHERTYPE, EtherCatHeader
from eap.ids import InterfaceUri, MacAddr, NetId
from eap.net.ethernet import EthernetInterface, EthernetPort, packet_batch
from eap.net.image_file import ImageFile, create_image
from eap.net.packetsocket import open_packet_pair
from eap.pd.image import Image
from eap.pd.layout import plan_layout
from eap.pd.quality import tracker_word
from eap.pd.spec import (
    PortKind,
    PortSpec,
    RxPdSpec,
    StationSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Wake,
    Writer,
)
from eap.pd.station import Station
from eap.pd.words import FrameWord, RxWord

PUBLISHER = "10.134.164.1.2.1"
SUBSCRIBER = "10.134.164.2.2.1"
DESTINATION = "01:01:05:04:00:00"
CYCLE_US = 1000
ETHERNET_HEADER = 14
FRAME_HEADERS = 2 + 12
"""EtherCAT header and PD frame header, octets."""
PD_HEADER = 8


class Shape(msgspec.Struct, frozen=True):
    """Frames of each cycle: *frames* frames of *pds* PDs of *size* bytes each."""

    frames: int
    pds: int
    size: int
    type: str = ""
    """Type of each PD's variable; a raw block if empty."""

    @property
    def frame_size(self) -> int:
        """Octets of one frame from the EtherCAT header on."""
        return FRAME_HEADERS + self.pds * (PD_HEADER + self.size)

    def variables(self) -> list[list[VariableSpec]]:
        """Return the variables of each frame, one a PD; only the engine writes them."""
        kind = self.type or f"BLOCK({self.size})"
        return [
            [VariableSpec(f"v{frame}-{pd}", kind, Writer.ENGINE) for pd in range(self.pds)]
            for frame in range(self.frames)
        ]


def publishing(shape: Shape, interface: str) -> StationSpec:
    """Return the station that sends *shape* in each cycle."""
    variables = shape.variables()
    return StationSpec(
        name="publisher",
        net_id=NetId.parse("10.134.164.1.1.1"),
        cycle_us=CYCLE_US,
        ports=(
            PortSpec(
                "eap0",
                PortKind.EAP,
                InterfaceUri.parse(f"ethernet://{interface}"),
                NetId.parse(PUBLISHER),
            ),
        ),
        variables=tuple(variable for frame in variables for variable in frame),
        frames=tuple(
            TxFrameSpec(
                f"frame{number}",
                "eap0",
                DESTINATION,
                tuple(
                    TxPdSpec(f"to-{variable.name}", _pd_id(shape, number, pd), (variable.name,))
                    for pd, variable in enumerate(frame)
                ),
            )
            for number, frame in enumerate(variables)
        ),
    )


def subscribing(shape: Shape, interface: str) -> StationSpec:
    """Return the station that takes everything of :func:`publishing`."""
    variables = shape.variables()
    port = PortSpec(
        "eap0",
        PortKind.EAP,
        InterfaceUri.parse(f"ethernet://{interface}"),
        NetId.parse(SUBSCRIBER),
        wake=Wake.ARRIVAL,
    )
    return StationSpec(
        name="subscriber",
        net_id=NetId.parse("10.134.164.2.1.1"),
        cycle_us=CYCLE_US,
        phase_us=CYCLE_US // 2,
        ports=(port,),
        variables=tuple(variable for frame in variables for variable in frame),
        subscriptions=tuple(
            RxPdSpec(
                f"from-{variable.name}",
                "eap0",
                _pd_id(shape, number, pd),
                (variable.name,),
                PUBLISHER,
                sender_cycle_us=CYCLE_US,
                step=1,
            )
            for number, frame in enumerate(variables)
            for pd, variable in enumerate(frame)
        ),
    )


class Assembled:
    """A station with its image and its channel, as the engine process puts them together."""

    def __init__(self, file: ImageFile, station: Station, channel: EthernetPort) -> None:
        self.file = file
        self.station = station
        self.channel = channel


@contextmanager
def assemble(spec: StationSpec, folder: Path, interface: str) -> Iterator[Assembled]:
    """Build the station of *spec* on an Ethernet interface of this namespace."""
    with ExitStack() as stack:
        file = stack.enter_context(create_image(folder / f"{spec.name}.image", plan_layout(spec)))
        station = Station(spec, file.image, file.wake_waiters)
        engine_socket, services_socket = open_packet_pair(interface)
        stack.callback(services_socket.close)
        opened = EthernetInterface(engine_socket, packet_batch())
        stack.callback(opened.close)
        port = opened.port(station.handlers["eap0"])
        station.connect("eap0", port)
        yield Assembled(file, station, port)


def frame_octets(shape: Shape) -> bytes:
    """Return an Ethernet frame of *shape* as raw loops send it: its headers, and zeros."""
    header = MacAddr.parse(DESTINATION) + bytes(6) + ETHERTYPE.to_bytes(2)
    ethercat = EtherCatHeader(shape.frame_size - EtherCatHeader.SIZE).encode()
    return header + ethercat + bytes(shape.frame_size - EtherCatHeader.SIZE)


def frames_sent(image: Image) -> int:
    """Return how many frames went out, by the publisher's own counters."""
    return sum(image.words[frame.words + FrameWord.WHOLE] for frame in image.layout.frames)


def frames_received(image: Image, shape: Shape) -> tuple[int, int]:
    """Return how many frames were taken and how many were lost, by the subscriber's counters."""
    first_of_frames = image.layout.rx[:: shape.pds]
    accounts = [tracker_word(image, place) for place in first_of_frames]
    received = sum(image.words[first + RxWord.RECEIVED] for first in accounts)
    return received, sum(image.words[first + RxWord.LOST] for first in accounts)


def _pd_id(shape: Shape, frame: int, pd: int) -> int:
    return 1 + frame * shape.pds + pd
