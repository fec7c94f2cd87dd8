"""A simulated segment as a process: it answers a master until it receives an end signal.

``eapctl sim run`` runs one in its own process; the supervisor starts one for each simulated bus
with one argument, the descriptor of its handover.  Commands come as JSON (:mod:`command`), as lines
or as messages; each is answered, with its *id* if it has one.
"""

from __future__ import annotations

import gc
import os
import select
import socket
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Protocol

import msgspec

from devicebus.sim.fault import FaultySegment, Outgoing, execute_command
from devicebus.sim.segment import SegmentEnd
from eap.errors import ConfigError
from eap.ids import InterfaceUri
from eap.net import realtime
from eap.net.busport import SegmentSocket, open_segment
from eap.runtime.busfile import BusFile, load_or_raise
from eap.runtime.handover import NO_DESCRIPTOR, SegmentHandover
from eap.runtime.startup import Startup, catch_end_signals

_MS = 1_000_000
_STALL_NS = 2_000_000
"""Lateness from which frames that wait are taken before the watchdogs of slaves are looked at."""
_NEVER_NS = 1 << 63
_MAX_COMMAND = 65536


class Commands(Protocol):
    """Source of commands and sink of their answers."""

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when there is a command."""

    def read(self) -> Iterable[bytes] | None:
        """Return the commands that wait, None when no more will come."""

    def answer(self, outcome: dict[str, Any]) -> None:
        """Answer one command; neither waits nor fails."""


class CommandLines:
    """Commands as lines from *fd*, answered by *say*."""

    def __init__(self, fd: int, say: Callable[[dict[str, Any]], None]) -> None:
        self.answer = say
        self._fd = fd
        self._partial = b""

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._fd

    def read(self) -> Iterable[bytes] | None:
        """Return all whole lines that are there."""
        data = os.read(self._fd, _MAX_COMMAND)
        *lines, rest = (self._partial + data).split(b"\n")
        self._partial = rest[-_MAX_COMMAND:]
        return [line for line in map(bytes.strip, lines) if line] if data else None


class CommandMessages:
    """Commands as messages of *sock*; a client that does not read loses its answers."""

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        sock.setblocking(False)

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._sock.fileno()

    def read(self) -> Iterable[bytes] | None:
        """Return the next message."""
        try:
            data = self._sock.recv(_MAX_COMMAND)
        except OSError:
            return ()
        return [data] if data else None

    def answer(self, outcome: dict[str, Any]) -> None:
        """Send one message."""
        try:
            self._sock.send(msgspec.json.encode(outcome))
        except OSError:
            return


def run(
    bus: BusFile,
    interface: InterfaceUri,
    say: Callable[[dict[str, Any]], None],
    *,
    second: InterfaceUri | None = None,
    command_fd: int | None = None,
) -> None:
    """Answer on *interface* until SIGINT or SIGTERM.

    Args:
        bus: What answers.
        interface: Where.
        say: Called with ``{"ready": true, "slaves": n}`` when the segment answers, and with the
            outcome of each command.
        second: The other line of a ring.
        command_fd: Where commands come from.

    Raises:
        EnvironmentalError: *interface* cannot be opened.
    """
    segment = bus.build()
    with catch_end_signals() as end_fd, ExitStack() as stack:
        sockets: dict[SegmentEnd, SegmentSocket] = {}
        for side, uri in zip(SegmentEnd, (interface, second), strict=True):
            if uri is not None:
                sockets[side] = open_segment(uri)
                stack.callback(sockets[side].close)
        say({"ready": True, "slaves": len(bus.spec.slaves)})
        commands = None if command_fd is None else CommandLines(command_fd, say)
        _Loop(segment, sockets, commands).run(end_fd)


def run_for_appliance(handover: SegmentHandover, startup: Startup) -> None:
    """Answer the engine at the other end of a pair until SIGTERM.

    Raises:
        ConfigError: the bus file is none; one line a finding.
    """
    startup.step("reading the bus file")
    bus = load_copy(handover)
    startup.step("building the slaves")
    segment = bus.build()
    with catch_end_signals() as end_fd, ExitStack() as stack:
        sockets = {}
        for side, fd in zip(SegmentEnd, (handover.frames_fd, handover.second_fd), strict=True):
            if fd != NO_DESCRIPTOR:
                sockets[side] = frames = SegmentSocket(socket.socket(fileno=fd))
                stack.callback(frames.close)
                while frames.receive() is not None:
                    continue  # sent while no segment ran; the engine no longer waits for it
        commands = stack.enter_context(socket.socket(fileno=handover.command_fd))
        gc.collect()
        gc.freeze()
        startup.finish({"slaves": len(bus.spec.slaves)})
        _Loop(segment, sockets, CommandMessages(commands)).run(end_fd)


def load_copy(handover: SegmentHandover) -> BusFile:
    """Return the bus file with the slaves that it had when it was applied.

    They are copied at the first start: the file may be edited, and be applied and rolled back.

    Raises:
        ConfigError: the bus file is none; one line a finding.
    """
    copy, file = Path(handover.copy), Path(handover.file)
    if not handover.copy:
        return load_or_raise(file)
    with suppress(OSError, ValueError):
        return msgspec.msgpack.decode(copy.read_bytes(), type=BusFile)
    bus = load_or_raise(file)
    if bus.digest() != handover.digest:
        sys.stderr.write(
            f"segment: {file} has changed since it was applied: it is played as it is\n"
        )
        return bus
    temporary = copy.with_suffix(f".{os.getpid()}")
    with suppress(OSError):  # without a copy the file is played as it is
        temporary.write_bytes(msgspec.msgpack.encode(bus))
        temporary.replace(copy)
    return bus


class _Loop:
    def __init__(
        self,
        segment: FaultySegment,
        sockets: Mapping[SegmentEnd, SegmentSocket],
        commands: Commands | None,
    ) -> None:
        self._segment = segment
        self._sockets = sockets
        self._commands = commands
        self._origins: dict[SegmentEnd, bytes | tuple[str, int]] = {}
        """Origin of the last frame of each line."""
        self._late_ns = 0
        """Time after which this process has not run for a while, though there was work."""

    def run(self, end_fd: int) -> None:
        poll = select.poll()
        command_fd = self._commands.fileno() if self._commands is not None else None
        for fd in (end_fd, command_fd, *(each.fileno() for each in self._sockets.values())):
            if fd is not None:
                poll.register(fd, select.POLLIN)
        while True:
            for fd, _ in poll.poll(self._poll_timeout_ms()):
                if fd == end_fd:
                    return
                if fd == command_fd and not self._receive_commands():
                    poll.unregister(fd)
            self._forward_frames()

    def _poll_timeout_ms(self) -> float | None:
        due, now_ns = self._segment.next_timeout(), time.monotonic_ns()
        self._late_ns = _NEVER_NS if due is None else max(due, now_ns) + _STALL_NS
        return None if due is None else max(0.0, (due - now_ns) / _MS)

    def _forward_frames(self) -> None:
        """Forward the next frame of each line, or run due timers if none waits."""
        # One: the copies of a frame on both lines of a ring pass at about the same time, and for
        # the usual single frame the next poll costs less than to look again.
        for side, sock in self._sockets.items():
            self._forward_frame(side, sock)

    def _forward_frame(self, side: SegmentEnd, sock: SegmentSocket) -> None:
        segment = self._segment
        arrival = sock.receive()
        now_ns = time.monotonic_ns()
        if arrival is not None and now_ns > self._late_ns:
            segment.segment.postpone_timeouts(now_ns)
        self._late_ns = now_ns + _STALL_NS
        if arrival is None:
            segment.handle_timeout(now_ns)
        else:
            self._origins[side] = arrival.origin
            segment.receive_frame(arrival.frame, now_ns, side=side, origin=arrival.origin)
        for out in segment.frames_to_send(now_ns):
            self._send(out)

    def _send(self, out: Outgoing) -> None:
        origin = out.origin
        # By UDP each line of the master has its own address, and takes frames from its end only.
        if isinstance(origin, tuple) and len(self._sockets) > 1:
            origin = self._origins.get(out.side)
        if out.side in self._sockets and origin is not None:
            self._sockets[out.side].send(out.frame, origin)

    def _receive_commands(self) -> bool:
        assert self._commands is not None  # noqa: S101  only called when it is readable
        commands = self._commands.read()
        for text in commands or ():
            self._commands.answer(self._obey(text))
        return commands is not None

    def _obey(self, text: bytes) -> dict[str, Any]:
        outcome: dict[str, Any] = {"ok": True}
        try:
            command = msgspec.json.decode(text)
            if isinstance(command, dict) and "id" in command:
                outcome["id"] = command.pop("id")
            execute_command(self._segment, command, time.monotonic_ns())
        except (ValueError, RecursionError) as exc:
            outcome |= {"ok": False, "error": str(exc)}
        return outcome


def main(handover_fd: int, startup: Startup) -> int:
    """Return the exit code: 2 for a bus file that is none."""
    handover = SegmentHandover.from_descriptor(handover_fd)
    realtime.die_with_parent(handover.supervisor)
    if handover.realtime:
        # Hardware does not wait for a processor: simulated slaves answer as late as this does.
        realtime.raise_process_priority()
    try:
        run_for_appliance(handover, startup)
    except ConfigError as exc:
        sys.stderr.write(f"segment: {exc}\n")
        return 2
    return 0
