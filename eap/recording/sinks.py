"""Files of captured blocks: values to MCAP, frames to pcapng."""

from __future__ import annotations

import socket
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Generic, TypeVar

from eap.codec.ethercat import EAP_PORT, FrameType
from eap.config.record_texts import matcher
from eap.ids import EAP_MULTICAST_MAC, Destination, DestinationKind, InterfaceUri, MacAddr, NetId
from eap.net.busport import BUS_MULTICAST_MAC
from eap.pd.address import from_word
from eap.pd.framering import RingRecord
from eap.pd.layout import ImageLayout
from eap.quantities import count
from eap.recording.capture import CapturedBlock, Gap, frames_in, samples_in
from eap.recording.frames_writer import FramesWriter, Wrapping, ethernet_wrapping, udp_wrapping
from eap.recording.header import AttachedFile, EventKind, RecordingEvent, RecordingHeader
from eap.recording.messages import PlacedVariable, RecordedVariable
from eap.recording.published import published_by
from eap.recording.selection import select_variables
from eap.recording.values_writer import ValuesWriter
from eap.runtime.folder import ApplianceInfo

_PUBLISHER = slice(2, 8)
"""Of a frame of process data: the NetID of its sender."""
_PROCESSED = 0x02
_WRAPPINGS = 4096

WriterT = TypeVar("WriterT", bound=ValuesWriter | FramesWriter)


def header_of(
    info: ApplianceInfo, layouts: Sequence[ImageLayout], options: Mapping[str, str], time_ns: int
) -> RecordingHeader:
    """Return the header of a recording that begins at Unix time *time_ns*."""
    files = []
    with suppress(OSError):  # the file may have gone since
        path = Path(info.plant_file)
        files = [AttachedFile(path.name, path.read_bytes())]
    return RecordingHeader(
        plant=info.plant,
        host=socket.gethostname(),
        started_ns=time_ns,
        options=dict(options),
        files=tuple(files),
        published=published_by(layouts),
    )


def event_of(gap: Gap) -> RecordingEvent:
    """Return the event of what is missing."""
    if gap.is_loss:
        return RecordingEvent(
            time_ns=gap.time_ns, kind=EventKind.LOST, station=gap.source, count=gap.missing
        )
    text = f"the engine was restarted: {count(gap.missing, 'cycle')} did not run"
    return RecordingEvent(time_ns=gap.time_ns, kind=EventKind.MARK, station=gap.source, text=text)


def placed_variables(layout: ImageLayout, patterns: Sequence[str]) -> list[PlacedVariable]:
    """Return the variables of a station that *patterns* select, with their places in a sample."""
    first_bit = 8 * layout.samples.first
    return [
        PlacedVariable(
            RecordedVariable(slot.name, slot.type, slot.unit), slot.bit_offset - first_bit
        )
        for slot in select_variables(layout, patterns)
    ]


class RecordedFile(Generic[WriterT]):
    """A file that is recorded, with the writer of its format."""

    def __init__(self, writer: WriterT) -> None:
        self._writer = writer

    @property
    def size(self) -> int:
        """Bytes of the file so far."""
        return self._writer.size

    def add_gap(self, gap: Gap) -> None:
        """Add what is missing."""
        self._writer.add_event(event_of(gap))

    def add_event(self, event: RecordingEvent) -> None:
        """Add an event."""
        self._writer.add_event(event)

    def flush(self) -> None:
        """Give all to the system, and have the disk keep it."""
        self._writer.flush()
        self._writer.sync()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._writer.abandon()


class ValuesSink(RecordedFile[ValuesWriter]):
    """An MCAP file.

    Args:
        path: A file that does not exist yet.
        header: Origin of the recording.
        layouts: Of the stations.
        patterns: Of the variables.
    """

    def __init__(
        self,
        path: Path,
        header: RecordingHeader,
        layouts: Sequence[ImageLayout],
        patterns: Sequence[str],
    ) -> None:
        super().__init__(ValuesWriter(path, header))
        self._stations = {
            layout.station: self._writer.add_station(layout.station, variables)
            for layout in layouts
            if (variables := placed_variables(layout, patterns))
        }

    @property
    def messages(self) -> int:
        """Number of messages so far."""
        return self._writer.messages

    def write(self, block: CapturedBlock) -> None:
        """Add a block."""
        station = self._stations.get(block.source)
        if station is None:
            return
        write = self._writer.write
        for cycle, time_ns, sample in samples_in(block):
            write(station, cycle, time_ns, sample)

    def close(self, time_ns: int) -> None:
        """End the file."""
        del time_ns  # its index has times already
        self._writer.close()


class FramesSink(RecordedFile[FramesWriter]):
    """A pcapng file.

    Args:
        path: A file that does not exist yet.
        header: Origin of the recording.
        layouts: Of the stations.
        patterns: Of the ports.
        ports: Returns the ports by their numbers in the records.
    """

    def __init__(
        self,
        path: Path,
        header: RecordingHeader,
        layouts: Sequence[ImageLayout],
        patterns: Sequence[str],
        ports: Callable[[], Sequence[str]],
    ) -> None:
        super().__init__(FramesWriter(path, header))
        self._is_selected = matcher(patterns)
        self._addressing = {
            f"{layout.station}/{port.name}": PortAddressing(
                port.interface, port.net_id, is_bus=port.kind == "bus"
            )
            for layout in layouts
            for port in layout.ports
        }
        self._ports_now = ports
        self._ports: list[str] = []
        self._wanted: list[bool] = []
        self._interfaces: dict[int, int] = {}
        self._wrappings: dict[tuple[int, bool, int, bytes], Wrapping] = {}

    @property
    def messages(self) -> int:
        """Number of frames so far."""
        return self._writer.frames

    def write(self, block: CapturedBlock) -> None:
        """Add a block."""
        names = self._ports_now()
        if len(names) != len(self._ports):
            self._ports = list(names)
            self._wanted = [self._is_selected(name) for name in names]
        interfaces, write = self._interfaces, self._writer.write
        for time_ns, record in frames_in(block, self._wanted):
            interface = interfaces.get(record.port)
            if interface is None:
                interface = self._open_interface(record.port)
            wrapping = self._wrapping(record)
            write(interface, time_ns, wrapping.wrap(record.frame), outbound=record.is_sent)

    def close(self, time_ns: int) -> None:
        """End the file."""
        self._writer.close(time_ns)

    def _open_interface(self, port: int) -> int:
        name = self._ports[port]
        description = self._addressing[name].interface if name in self._addressing else ""
        self._interfaces[port] = self._writer.add_interface(name, description)
        return self._interfaces[port]

    def _wrapping(self, record: RingRecord) -> Wrapping:
        # A line in memory has no addresses: the sender stands in frames of process data.
        frame = record.frame
        is_process_data = len(frame) > 1 and frame[1] >> 4 == FrameType.PROCESS_DATA
        publisher = frame[_PUBLISHER] if is_process_data and not record.address else b""
        key = record.port, record.is_sent, record.address, publisher
        found = self._wrappings.get(key)
        if found is None:
            if len(self._wrappings) >= _WRAPPINGS:
                self._wrappings.clear()  # hosts may forge any number of addresses
            own = self._addressing.get(self._ports[record.port]) or PortAddressing("", "")
            found = self._wrappings[key] = own.wrapping(record, publisher)
        return found


class PortAddressing:
    """Addresses of one port, for the headers in front of its frames.

    Args:
        interface: Its URI.
        net_id: Its NetID.
        is_bus: Whether it is the port of a bus of slaves.
    """

    def __init__(self, interface: str, net_id: str, *, is_bus: bool = False) -> None:
        self.interface = interface
        self._is_bus = is_bus
        self._mac = _mac_of(bytes(NetId.parse(net_id))) if net_id else EAP_MULTICAST_MAC
        self._udp: tuple[str, int] | None = None
        uri = InterfaceUri.parse(interface) if interface else None
        if uri is not None and uri.scheme == "udp":
            self._udp = uri.host, uri.port or EAP_PORT
        elif uri is not None and uri.scheme == "ethernet":
            self._mac = _address_of(uri.host) or self._mac

    def wrapping(self, record: RingRecord, publisher: bytes) -> Wrapping:
        """Return the headers of *record*; *publisher* is its sender where it has no address."""
        if self._is_bus:
            # The first slave sets a bit of the source address in what it sends on (ETG.1000.4).
            first = self._mac[0] & ~_PROCESSED if record.is_sent else self._mac[0] | _PROCESSED
            return ethernet_wrapping(MacAddr(bytes((first,)) + self._mac[1:]), BUS_MULTICAST_MAC)
        other = from_word(record.address)
        if other is not None and self._udp is not None and other.kind is not DestinationKind.MAC:
            peer = other.host, other.port or EAP_PORT
            ends = (self._udp, peer) if record.is_sent else (peer, self._udp)
            return udp_wrapping(*ends)
        peer_mac = _peer_mac(other, record, publisher)
        if record.is_sent:
            return ethernet_wrapping(self._mac, peer_mac)
        return ethernet_wrapping(peer_mac, self._mac)


def _peer_mac(other: Destination | None, record: RingRecord, publisher: bytes) -> MacAddr:
    if other is not None and other.kind is DestinationKind.MAC:
        return MacAddr.parse(other.host)
    if other is not None:
        return MacAddr(b"\x02\x00" + socket.inet_aton(other.host))
    if record.is_sent or len(publisher) < 6:
        return EAP_MULTICAST_MAC
    return _mac_of(publisher)


def _mac_of(net_id: bytes) -> MacAddr:
    """Return a locally administered address that stands for a NetID."""
    return MacAddr(b"\x02" + net_id[1:6])


def _address_of(interface: str) -> MacAddr | None:
    try:
        return MacAddr.parse(Path(f"/sys/class/net/{interface}/address").read_text().strip())
    except (OSError, ValueError):
        return None
