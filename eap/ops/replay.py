"""Replay of a recording: its frames are sent again as their publishers sent them."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from msgspec import Struct

from eap.codec.ethercat import FrameType
from eap.codec.pd import PD_FRAME_START
from eap.errors import ConfigError, ControlError, EnvironmentalError, LocalProtocolError
from eap.ids import InterfaceUri, MacAddr, NetId
from eap.net.replaysocket import ReplayRawSocket, ReplayUdpSocket, hear, is_ipv4
from eap.ops.client import connect_those
from eap.ops.recordings import published_in
from eap.recording.frames_writer import ethernet_wrapping
from eap.recording.packets import unwrap
from eap.recording.recording_file import open_recording
from eap.recording.replay import (
    ReplayClock,
    ReplayFrame,
    ReplayPlan,
    ReplaySender,
    frames_of,
    impersonate,
    senders_of,
)
from eap.recording.replay_status import ReplayProgress, ReplayStatus

LISTEN_S = 1.5
"""Time to listen for a publisher on an Ethernet interface."""
_AHEAD = 2000
"""Frames that are read before they are due."""
_SPARE_NS = 2_000_000
"""Time before a frame is due in which no other one is read."""


class ReplayRequest(Struct, frozen=True, kw_only=True):
    """``eapctl replay``; see there."""

    file: Path
    rate: float = 1.0
    is_loop: bool = False
    only: str = ""
    as_station: str = ""
    is_forced: bool = False
    plant: Path | None = None


class PlannedFrames(Struct, frozen=True):
    """Frames that a replay sends from one port to one destination."""

    station: str
    port: str
    publisher: str
    interface: str
    destination: str
    pds: list[str]
    frames: int
    per_s: float | None


class ReplayResult(Struct, frozen=True, kw_only=True):
    """Frames of a replay, planned (``--dry-run``) or sent.

    *late_us* is the largest delay of a frame behind its time; *left_out* are PDs and publishers
    that cannot be sent, and *failed* frames that the kernel refused, each by reason.
    """

    file: str
    plant: str
    seconds: float
    frames: list[PlannedFrames]
    left_out: dict[str, str]
    sent: int = 0
    rounds: int = 0
    late_us: int = 0
    failed: dict[str, int] = {}


class Replay:
    """One replay, from its plan to its end.

    Args:
        request: What to send.

    Raises:
        ConfigError: there is nothing to send, or the station of ``--as`` does not fit.
        MalformedError: it is no recording.
        OSError: the file cannot be read.
    """

    def __init__(self, request: ReplayRequest) -> None:
        self._request = request
        self._recording = open_recording(request.file, published_in(request.plant))
        self._left_out: dict[str, str] = {}
        self._plan = ReplayPlan()
        self._first_ns = self._last_ns = 0
        for frame in self._frames():
            self._plan.add(frame)
            self._first_ns = self._first_ns or frame.at_ns
            self._last_ns = max(self._last_ns, frame.at_ns)
        if not self._recording.published:
            raise ConfigError(
                f"{request.file} does not say which plant is in it: name its file with --plant"
            )
        if not self._plan.rows:
            reasons = "; ".join(f"{name}: {why}" for name, why in self._left_out.items())
            hint = " that --only matches" if request.only else ""
            raise ConfigError(
                f"{request.file} has no process data to send{hint}"
                + (f": {reasons}" if reasons else "")
            )
        self.stopped = threading.Event()
        self.progress = ReplayProgress(
            file=str(request.file),
            rate=request.rate,
            is_loop=request.is_loop,
            seconds=(self._last_ns - self._first_ns) / 1e9,
        )
        self._late_ns = 0

    def result(self) -> ReplayResult:
        """Return what is planned, and what was sent so far."""
        rows = []
        for row in self._plan.rows.values():
            span_s = (row.last_ns - row.first_ns) / 1e9
            per_s = round((row.frames - 1) / span_s * self._request.rate, 3) if span_s else None
            sender = row.sender
            rows.append(
                PlannedFrames(
                    sender.station,
                    sender.port,
                    sender.publisher,
                    sender.interface,
                    row.destination,
                    list(row.names),
                    row.frames,
                    per_s,
                )
            )
        return ReplayResult(
            file=str(self._request.file),
            plant=self._recording.facts.get("plant", ""),
            seconds=self.progress.seconds,
            frames=rows,
            left_out=self._left_out,
            sent=sum(self.progress.sent.values()),
            rounds=self.progress.rounds,
            late_us=self._late_ns // 1000,
            failed=self.progress.failed,
        )

    def run(
        self,
        wait_step: Callable[[ReplayFrame], bool] | None = None,
        *,
        notify_begin: Callable[[], object] = lambda: None,
    ) -> None:
        """Send all frames.

        Args:
            wait_step: Called before each frame; returns False to end.
            notify_begin: Called when the first frame is about to be sent.

        Raises:
            LocalProtocolError: a publisher is alive.
            EnvironmentalError: an interface cannot be used.
        """
        plant = self._recording.facts.get("plant", "") or self._request.file.stem
        if not self._request.is_forced:
            self._require_silence()
        with ExitStack() as stack:
            senders = {
                publisher: self._open(sender, stack)
                for publisher, sender in self._plan.senders.items()
            }
            stack.enter_context(ReplayStatus(plant, self._plan, self.progress, self.stopped.set))
            clock = ReplayClock(self._request.rate)
            notify_begin()
            while not self.stopped.is_set():
                clock.begin_round(time.monotonic_ns())
                self._send_round(clock, senders, wait_step)
                if self.stopped.is_set() or not self._request.is_loop:
                    break
                self.progress.rounds += 1

    def _send_round(
        self,
        clock: ReplayClock,
        senders: dict[str, _Send],
        wait_step: Callable[[ReplayFrame], bool] | None,
    ) -> None:
        waiting: deque[tuple[int, ReplayFrame]] = deque()
        source = ((clock.due_ns(frame), frame) for frame in self._frames())
        is_over = False
        while not self.stopped.is_set():
            if not waiting:
                if (item := next(source, None)) is None:
                    return
                waiting.append(item)
            due_ns, frame = waiting[0]
            if wait_step is not None:
                if not wait_step(frame):
                    self.stopped.set()
                    return
            elif (left_ns := due_ns - time.monotonic_ns()) > 0:
                # Frames are read ahead in the time that is left, so that none waits for the file.
                if not is_over and left_ns > _SPARE_NS and len(waiting) < _AHEAD:
                    if (item := next(source, None)) is None:
                        is_over = True
                    else:
                        waiting.append(item)
                else:
                    self.stopped.wait(left_ns / 1e9)
                continue
            else:
                self._late_ns = max(self._late_ns, -left_ns)
            waiting.popleft()
            self._send(clock, frame, senders)

    def _send(self, clock: ReplayClock, frame: ReplayFrame, senders: dict[str, _Send]) -> None:
        progress = self.progress
        progress.position_s = (frame.at_ns - self._first_ns) / 1e9
        try:
            senders[frame.sender.publisher](frame, clock.numbered(frame))
        except OSError as exc:
            reason = exc.strerror or str(exc)
            progress.failed[reason] = progress.failed.get(reason, 0) + 1
            return
        key = frame.sender.publisher, frame.destination, frame.names
        progress.sent[key] = progress.sent.get(key, 0) + 1

    def _frames(self) -> Iterator[ReplayFrame]:
        frames = frames_of(self._recording, self._left_out, self._request.only)
        if not self._request.as_station:
            return frames
        senders = senders_of(self._recording.published)
        return impersonate(frames, self._request.as_station, senders)

    def _open(self, sender: ReplaySender, stack: ExitStack) -> _Send:
        uri = _interface(sender)
        if uri.scheme == "udp":
            try:
                udp = ReplayUdpSocket(uri.host, is_exclusive=not self._request.is_forced)
            except BlockingIOError as exc:
                raise _alive(sender, str(exc)) from None
            stack.enter_context(udp)
            return lambda frame, data: udp.send(data, frame.destination)
        raw = stack.enter_context(ReplayRawSocket(uri.host))
        return lambda frame, data: raw.send(_packet(frame, data), "")

    def _require_silence(self) -> None:
        """Raise LocalProtocolError if one of the publishers is alive."""
        running = _running_ports()
        for publisher, sender in self._plan.senders.items():
            if publisher in running:
                raise _alive(sender, f"{running[publisher]} runs on this host")
        interfaces = {
            _interface(sender).host
            for sender in self._plan.senders.values()
            if _interface(sender).scheme == "ethernet"
        }
        for interface in sorted(interfaces):
            self._listen(interface)

    def _listen(self, interface: str) -> None:
        wanted = {NetId.parse(publisher) for publisher in self._plan.senders}
        heard: set[bytes] = set()

        def is_wanted(octets: bytes) -> bool:
            packet = unwrap(octets)
            data = b"" if packet is None else packet.payload
            if len(data) < 8 or data[1] >> 4 != FrameType.PROCESS_DATA:
                return False
            publisher = data[PD_FRAME_START : PD_FRAME_START + 6]
            heard.add(publisher)
            return publisher in wanted

        if hear(interface, is_wanted, LISTEN_S):
            publisher = str(NetId(next(each for each in heard if each in wanted)))
            sender = self._plan.senders[publisher]
            raise _alive(sender, f"its frames pass ethernet://{interface}")


_Send = Callable[[ReplayFrame, bytes], Any]


def _interface(sender: ReplaySender) -> InterfaceUri:
    uri = InterfaceUri.parse(sender.interface)
    if uri.scheme == "ethernet" or (uri.scheme == "udp" and is_ipv4(uri.host)):
        return uri
    raise EnvironmentalError(
        f"{sender.station}/{sender.port}: {sender.interface} cannot be replayed from outside its"
        " process: only udp:// and ethernet:// ports can; choose others with --only"
    )


def _alive(sender: ReplaySender, why: str) -> LocalProtocolError:
    return LocalProtocolError(
        f"publisher {sender.publisher} ({sender.station}/{sender.port}) is alive: {why}; stop it,"
        " replay as another station with --as, or send beside it with --force"
    )


def _running_ports() -> dict[str, str]:
    """Return the stations that run on this host, by the NetIDs of their ports."""
    found: dict[str, str] = {}
    try:
        clients = connect_those(lambda _: True)
    except ControlError:
        return found  # it starts or ends; the sockets tell
    for client in clients:
        with client:
            try:
                answer = client.request("status")
            except ControlError:
                continue
            for station in answer["stations"]:
                for port in station["ports"]:
                    found[port["net_id"]] = station["name"]
    return found


def _packet(frame: ReplayFrame, data: bytes) -> bytes:
    """Return the Ethernet frame of *data*: as recorded, else made of the addresses."""
    if frame.packet:
        start = frame.packet.rfind(frame.data)
        return frame.packet[:start] + data
    source = MacAddr(b"\x02\x00" + NetId.parse(frame.sender.publisher)[:4])
    return ethernet_wrapping(source, MacAddr.parse(frame.destination)).wrap(data)
