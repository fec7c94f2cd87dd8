"""The process of one recording: its loop, its requests and its end.

``eapctl record start`` starts it in a session of its own, so that it outlives the terminal.  It
reports on stdout that it records, or why it does not, and closes that.  The supervisor starts those
of the plant file, which end with it.  Requests come by a socket in its folder: a JSON line each,
answered by one.
"""

from __future__ import annotations

import logging
import os
import select
import signal
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from time import monotonic_ns

import msgspec

from eap.config.record_texts import KEEP, parse_every, split_of, times_of
from eap.errors import EapError, EnvironmentalError
from eap.recording.recorder import Recorder, RecorderOptions
from eap.runtime.handover import RecorderHandover
from eap.runtime.recordings import RecordingFolder, RecordingState, forget_old_recordings
from eap.runtime.startup import Startup

logger = logging.getLogger(__name__)

_CHECK_NS = 500_000_000
_MAX_LINE = 65_536
_MAX_CLIENTS = 16


STORE_VARIABLE = "EAP_RECORD_TO"
"""Environment variable with the URL of the store."""


class RecorderRequest(msgspec.Struct, kw_only=True):
    """One request; *do* is ``state``, ``mark``, ``snapshot`` or ``stop``."""

    do: str
    text: str = ""


class RecorderAnswer(msgspec.Struct, kw_only=True, omit_defaults=True):
    """One answer; *error* is empty if the request was done."""

    state: RecordingState | None = None
    error: str = ""


class RecorderProcess:
    """Runs *recorder* until it ends, and serves requests.

    Args:
        recorder: The recording.
        folder: Its folder, locked.
        parent: Process without which it ends; 0 for none.
    """

    def __init__(self, recorder: Recorder, folder: RecordingFolder, parent: int = 0) -> None:
        self._recorder = recorder
        self._folder = folder
        self._parent = parent
        self._server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._server.bind(str(folder.control_socket))
        self._server.listen(_MAX_CLIENTS)
        self._clients: dict[int, tuple[socket.socket, bytes]] = {}
        self._waiting: list[tuple[socket.socket, threading.Event]] = []
        self._ending: list[socket.socket] = []
        self._stops = False

    def stop(self, number: int, frame: object) -> None:
        """End the recording in the next look; a signal handler."""
        del number, frame
        self._stops = True

    def run(self, report: Callable[[RecorderAnswer], object]) -> int:
        """Run until the recording ends; return the exit code.

        Args:
            report: Called once, when it records or waits for its plant, or cannot.
        """
        recorder = self._recorder
        look_ns = check_ns = 0
        is_reported = False
        while not recorder.is_over:
            now_ns = monotonic_ns()
            if reason := self._reason_to_end():
                recorder.end(reason, now_ns)
                break
            if now_ns >= look_ns:
                look_ns = recorder.look(now_ns)
                if not is_reported and recorder.is_settled:
                    is_reported = True
                    # Written before: a list may be asked for right after the start.
                    report(RecorderAnswer(state=self._describe(now_ns)))
            if now_ns >= check_ns:
                check_ns = now_ns + _CHECK_NS
                self._describe(now_ns)
            self._serve(min(look_ns, check_ns) - monotonic_ns())
        state = self._describe(monotonic_ns())
        if not is_reported:
            report(RecorderAnswer(error=state.reason))
        elif recorder.has_failed:
            logger.error("%s", state.reason)  # the last line, which a supervisor shows
        for client in self._ending:
            self._answer(client, RecorderAnswer(state=state))
        if not recorder.has_failed:
            return 0
        return 1 if is_reported else 2

    def _reason_to_end(self) -> str:
        if self._stops:
            return "stopped"
        # A supervisor that was killed sends no signal.
        is_orphan = self._parent and os.getppid() != self._parent
        return "the appliance ended" if is_orphan else ""

    def _describe(self, now_ns: int) -> RecordingState:
        """Write the state of the recording to its folder, and return it."""
        state = self._recorder.check(now_ns)
        try:
            self._folder.write(state)
        except FileNotFoundError:
            # Nobody could find the recording, or end it.
            self._recorder.end("its folder in the runtime directory was removed", now_ns)
        except OSError:
            pass  # the runtime directory is full: the recording goes on
        return state

    def _serve(self, timeout_ns: int) -> None:
        """Serve requests for *timeout_ns*, or until the first."""
        descriptors = [self._server.fileno(), *self._clients]
        readable, _, _ = select.select(descriptors, [], [], max(0, timeout_ns) / 1e9)
        for fd in readable:
            if fd == self._server.fileno():
                self._accept()
            else:
                self._read(fd)
        for client, done in list(self._waiting):
            if done.is_set():
                self._waiting.remove((client, done))
                self._answer(client, RecorderAnswer(state=self._recorder.check(monotonic_ns())))

    def _accept(self) -> None:
        with suppress(OSError):
            client, _ = self._server.accept()
            # Each client has a descriptor, which the files need, too.
            if len(self._clients) >= _MAX_CLIENTS:
                client.close()
                return
            client.setblocking(False)
            self._clients[client.fileno()] = client, b""

    def _read(self, fd: int) -> None:
        client, before = self._clients.pop(fd)
        data = b""
        with suppress(OSError):
            data = client.recv(_MAX_LINE)
        line, end, _ = (before + data).partition(b"\n")
        if end:
            self._handle(client, line)
        elif data and len(line) < _MAX_LINE:
            self._clients[fd] = client, line
        else:
            client.close()

    def _handle(self, client: socket.socket, line: bytes) -> None:
        recorder, now_ns = self._recorder, monotonic_ns()
        try:
            request = msgspec.json.decode(line, type=RecorderRequest)
            if request.do == "stop":
                self._require_own_end()
                # Answered when the files are whole: only then may they be copied.
                self._ending.append(client)
                self._stops = True
                return
            if request.do == "snapshot":
                self._waiting.append((client, recorder.snapshot(now_ns)))
                return
            if request.do == "mark":
                recorder.mark(request.text, now_ns)
            answer = RecorderAnswer(state=recorder.check(now_ns))
        except (EapError, ValueError, RecursionError) as exc:
            answer = RecorderAnswer(error=str(exc))
        self._answer(client, answer)

    def _require_own_end(self) -> None:
        """Raise EnvironmentalError if the recording ends with the plant only."""
        state = self._recorder.state
        if state.is_of_plant:
            raise EnvironmentalError(
                f"recording {state.name!r} is in the plant file, so it ends with the plant: remove"
                " it from the key 'record', and start the plant again"
            )

    def _answer(self, client: socket.socket, answer: RecorderAnswer) -> None:
        with suppress(OSError):  # it may have gone
            client.send(msgspec.json.encode(answer) + b"\n")
        client.close()


def main(descriptor: int, startup: Startup) -> int:
    """Record as a recording of the plant file until SIGTERM, or until the supervisor ends."""
    handover = RecorderHandover.from_descriptor(descriptor)

    def report(answer: RecorderAnswer) -> None:
        if answer.error:
            startup.step(answer.error)
        else:
            startup.finish({})

    return _record(plant_options(handover), report, handover.supervisor)


def plant_options(handover: RecorderHandover) -> RecorderOptions:
    """Return the options of a recording of the plant file."""
    record = handover.record
    return RecorderOptions(
        name=record.name,
        kind=record.kind,
        base=str(Path(record.folder, record.name)),
        plant=handover.plant,
        folder=handover.folder,
        patterns=record.patterns,
        **parse_every(record.every)._asdict(),
        **times_of(record)._asdict(),
        **split_of(record)._asdict(),
        when=record.when,
        keep=0 if record.to else record.keep or KEEP,
        to=record.to,
        is_of_plant=True,
    )


def command_main(arguments: list[str]) -> int:
    """Record as ``arguments[0]``, RecorderOptions as JSON, says; return the exit code."""
    options = msgspec.json.decode(arguments[0], type=RecorderOptions)
    if options.to:
        # With its password, which arguments would show to all users of this host.
        options = msgspec.structs.replace(options, to=os.environ.pop(STORE_VARIABLE, options.to))
    return _record(options, _report)


def _record(
    options: RecorderOptions, report: Callable[[RecorderAnswer], object], parent: int = 0
) -> int:
    """Record until the recording ends, or the process *parent*; return the exit code."""
    try:
        folder = RecordingFolder.claim(options.name)
    except EapError as exc:
        report(RecorderAnswer(error=str(exc)))
        return 2
    with folder:
        forget_old_recordings()
        try:
            recorder = Recorder(options, monotonic_ns())
        except EapError as exc:
            report(RecorderAnswer(error=str(exc)))
            return 2
        recorder.state.pid = os.getpid()
        folder.write(recorder.state)
        process = RecorderProcess(recorder, folder, parent)
        signal.signal(signal.SIGTERM, process.stop)
        signal.signal(signal.SIGINT, process.stop)
        if not parent:
            _log_to(folder.log)
        return process.run(report)


def _report(answer: RecorderAnswer) -> None:
    """Write the outcome of the start, and close stdout: the starter does not wait any more."""
    with suppress(OSError):
        os.write(1, msgspec.json.encode(answer) + b"\n")
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.close(null)


def _log_to(path: Path) -> None:
    """Have what Python reports of an error go to *path*: the starter reads it only at the start."""
    log = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
    os.dup2(log, 2)
    os.close(log)


if __name__ == "__main__":
    sys.exit(command_main(sys.argv[1:]))
