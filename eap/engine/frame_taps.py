"""Recording of the frames of all ports, while a reader of the ring of frames wants them.

The engine looks for readers between its cycles.  Without one, nothing is in the path of a frame.
A received frame is recorded with the kernel's time stamp where there is one, a sent one with the
time just before the system call; so a frame that goes from one station of this appliance to another
is never received before it was sent.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from time import monotonic_ns

from eap.engine.rebuild import EngineStation
from eap.net.framering_file import FrameRingFile
from eap.pd.address import source_word, to_word
from eap.pd.framering import MAX_FRAME, FrameRingWriter, SentFrame
from eap.pd.link import ChannelLayer, FrameChannel, FrameHandler, FrameOrigin, OutFrame

_source_of = lru_cache(1024)(source_word)  # the same ones send again and again
_KNOWN = 1024
_GROUP = 64


class FrameTap:
    """Records the frames of one port, which has *number* in the ring."""

    def __init__(self, ring: FrameRingWriter, number: int) -> None:
        self._ring = ring
        self._number = number

    def received(self, handle: FrameHandler) -> FrameHandler:
        """Return a handler that records a frame and hands it to *handle*."""
        add, number = self._ring.add, self._number

        def record(data: memoryview, size: int, at_ns: int, origin: FrameOrigin) -> None:
            add(number, at_ns, _source_of(origin.source_of(data)), data[:size][:MAX_FRAME])
            handle(data, size, at_ns, origin)

        return record

    def sending(self, channel: FrameChannel) -> FrameChannel:
        """Return a channel that sends through *channel* and records what was sent."""
        return _RecordingChannel(channel, self._ring, self._number)


class _RecordingChannel(ChannelLayer):
    """A channel whose sent frames are recorded."""

    direct = None

    def __init__(self, channel: FrameChannel, ring: FrameRingWriter, number: int) -> None:
        super().__init__(channel)
        self._ring = ring
        self._number = number
        self._known: dict[OutFrame, SentFrame] = {}

    def send(self, frames: Sequence[OutFrame], now_ns: int) -> Sequence[OutFrame]:
        """Send *frames* and record those that were sent; return the others."""
        del now_ns
        # The time for loopback lines, too: what is received there has the time of the sending.
        at_ns = monotonic_ns()
        failed = self._channel.send(frames, at_ns)
        known = self._known
        sent = [
            known.get(frame) or self._describe(frame)
            for frame in frames
            if not failed or frame not in failed
        ]
        # In groups, each of which certainly fits into the ring.
        for first in range(0, len(sent), _GROUP):
            self._ring.add_sent(self._number, at_ns, sent[first : first + _GROUP])
        return failed

    def _describe(self, frame: OutFrame) -> SentFrame:
        """Return *frame* for the ring; it holds for the life of the frame."""
        if len(self._known) >= _KNOWN:
            self._known.clear()  # requesters may forge any number of addresses
        octets = frame.view[frame.headroom : frame.headroom + MAX_FRAME]
        described = SentFrame.of(to_word(frame.destination), octets)
        self._known[frame] = described
        return described


class FrameRecording:
    """Starts and ends the recording of the frames of *stations*.

    Args:
        file: The ring.
        stations: By name; exchanged while they run.
    """

    def __init__(self, file: FrameRingFile, stations: Mapping[str, EngineStation]) -> None:
        self._file = file
        self._stations = stations
        self._ring: FrameRingWriter | None = None
        self._is_on = False

    def look(self, now_ns: int) -> None:
        """Follow the readers, and the ports of the stations; called between two cycles."""
        if not self._file.header.is_wanted(now_ns):
            if self._is_on:
                self._is_on = False
                self._untap()
            return
        if self._ring is None:
            self._ring = self._file.writer()
        if self._ring is not None:
            self._is_on = True
            self._tap(self._ring)

    def _tap(self, ring: FrameRingWriter) -> None:
        for name, entry in self._stations.items():
            for port in entry.station.untapped_ports:
                number = ring.number(f"{name}/{port}")
                if number is not None:
                    entry.station.tap(port, FrameTap(ring, number))
            for port, bus in entry.buses.items():
                if any(line.tap is None for line in bus.lines):
                    number = ring.number(f"{name}/{port}")
                    tap = None if number is None else _bus_tap(ring, number)
                    for line in bus.lines:
                        line.tap = tap

    def _untap(self) -> None:
        for entry in self._stations.values():
            entry.station.untap()
            for bus in entry.buses.values():
                for line in bus.lines:
                    line.tap = None


def _bus_tap(ring: FrameRingWriter, number: int) -> Callable[[bytes, bool], None]:
    """Return the observer of the frames of a bus, both of whose lines have one."""
    add, add_sent = ring.add, ring.add_sent

    def record(frame: bytes, is_sent: bool) -> None:
        # Drivers of buses read no time stamps of the kernel.
        view, at_ns = memoryview(frame)[:MAX_FRAME], monotonic_ns()
        if is_sent:
            add_sent(number, at_ns, (SentFrame.of(0, view),))
        else:
            add(number, at_ns, 0, view)

    return record
