"""A simulated segment as a process: it answers a master until it is asked to end.

Commands come as JSON, one fault a line, on a descriptor; each is answered with a line by *say*.
"""

from __future__ import annotations

import os
import select
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import msgspec

from devicebus.sim.fault import FaultySegment
from devicebus.sim.spec import FaultSpec
from devicebus.sim.wiring import Side
from eap.appliance.busfile import Bus
from eap.appliance.signals import catch_end_signals
from eap.ids import InterfaceUri
from eap.net.segmentsocket import SegmentSocket, open_segment

_BATCH = 64
_MS = 1_000_000
_MAX_COMMAND = 65536


class FaultCommand(FaultSpec, frozen=True):
    """A fault as a command; with *end* the fault that it describes is over."""

    end: bool = False


def run(
    bus: Bus,
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
        sockets = {}
        for side, uri in zip(Side, (interface, second), strict=True):
            if uri is not None:
                sockets[side] = open_segment(uri)
                stack.callback(sockets[side].close)
        say({"ready": True, "slaves": len(bus.spec.slaves)})
        _Loop(segment, sockets, say, command_fd).run(end_fd)


class _Loop:
    def __init__(
        self,
        segment: FaultySegment,
        sockets: dict[Side, SegmentSocket],
        say: Callable[[dict[str, Any]], None],
        command_fd: int | None,
    ) -> None:
        self._segment = segment
        self._sockets = sockets
        self._say = say
        self._command_fd = command_fd
        self._partial = b""

    def run(self, end_fd: int) -> None:
        poll = select.poll()
        for fd in (end_fd, self._command_fd, *(each.fileno() for each in self._sockets.values())):
            if fd is not None:
                poll.register(fd, select.POLLIN)
        while True:
            for fd, _ in poll.poll(self._patience_ms()):
                if fd == end_fd:
                    return
                if fd == self._command_fd and not self._take_commands():
                    poll.unregister(fd)
            for side, sock in self._sockets.items():
                self._pass_frames(side, sock)

    def _patience_ms(self) -> float | None:
        due = self._segment.next_timeout()
        return None if due is None else max(0.0, (due - time.monotonic_ns()) / _MS)

    def _pass_frames(self, side: Side, sock: SegmentSocket) -> None:
        segment = self._segment
        for _ in range(_BATCH):
            arrival = sock.receive()
            now_ns = time.monotonic_ns()
            if arrival is None:
                segment.handle_timeout(now_ns)
            else:
                segment.receive_frame(arrival.frame, now_ns, side=side, origin=arrival.origin)
            for out in segment.frames_to_send(now_ns):
                if out.side in self._sockets:
                    self._sockets[out.side].send(out.frame, out.origin)
            if arrival is None:
                return

    def _take_commands(self) -> bool:
        assert self._command_fd is not None  # noqa: S101  only called when it is readable
        data = os.read(self._command_fd, _MAX_COMMAND)
        *lines, self._partial = (self._partial + data).split(b"\n")
        for line in filter(None, map(bytes.strip, lines)):
            self._obey(line)
        self._partial = self._partial[-_MAX_COMMAND:]
        return bool(data)

    def _obey(self, line: bytes) -> None:
        now_ns = time.monotonic_ns()
        try:
            command = msgspec.json.decode(line, type=FaultCommand)
            fault = msgspec.convert(msgspec.structs.asdict(command), FaultSpec)
            (self._segment.end if command.end else self._segment.begin)(fault, now_ns)
        except (msgspec.MsgspecError, ValueError) as exc:
            self._say({"ok": False, "error": str(exc)})
        else:
            self._say({"ok": True})
