"""Control socket of a replay: ``status`` shows its stations, and says that they are replayed.

A replay has a runtime folder as an appliance has, so that clients find it.  It answers the methods
``hello``, ``status``, ``pd_list``, ``variables`` and ``stop``.
"""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from typing import Any

from msgspec import Struct

from eap.closeable import Closeable
from eap.control.protocol import (
    MAX_LINE,
    VERSION,
    ErrorCode,
    Hello,
    decode_request,
    encode_error,
    encode_result,
    request_id,
)
from eap.errors import ControlError, EnvironmentalError
from eap.recording.replay import ReplayPlan, ReplaySender
from eap.release import RELEASE
from eap.runtime.folder import (
    ApplianceFolder,
    ApplianceInfo,
    ProcessInfo,
    folder_name,
    runtime_root,
)

NO_JITTER = {"p50": None, "p99": None, "max": None}


class ReplayProgress(Struct):
    """Present state of a replay; *position_s* counts from the begin of the recording."""

    file: str
    rate: float
    is_loop: bool
    seconds: float = 0.0
    position_s: float = 0.0
    rounds: int = 0
    sent: dict[tuple[str, str, tuple[str, ...]], int] = {}
    failed: dict[str, int] = {}
    """Frames that the kernel refused, by reason."""


def station_name(station: str) -> str:
    """Return the name of a station whose frames are replayed: the station itself may run too."""
    return f"{station} (replayed)"


class ReplayStatus(Closeable):
    """Server of the control socket, in a thread of its own.

    Args:
        plant: Name of the recorded plant.
        plan: All frames of the replay.
        progress: Read with each request.
        stop: Called once when a client asks for the end.

    Raises:
        EnvironmentalError: a replay of this plant runs already, or the folder cannot be used.
    """

    def __init__(
        self, plant: str, plan: ReplayPlan, progress: ReplayProgress, stop: Callable[[], None]
    ) -> None:
        self._plant = f"{plant} (replay)"
        self._plan = plan
        self._progress = progress
        self._stop = stop
        self._methods: Mapping[str, Callable[[dict[str, Any]], Any]] = {
            "hello": self._hello,
            "status": self._status,
            "pd_list": lambda _: [],
            "variables": lambda _: [],
            "stop": self._stopped,
        }
        stations = {each.station: None for each in plan.senders.values()}
        self.stations = [station_name(each) for each in stations]
        name = folder_name(self._plant)
        # Two replays at once would send with one NetID, and subscribers would see both as losses.
        if ApplianceFolder(runtime_root() / name).is_alive():
            raise EnvironmentalError(
                f"a replay of {plant} runs already: end it first (eapctl status shows its file)"
            )
        with ExitStack() as stack:
            folder = stack.enter_context(ApplianceFolder.claim(name))
            process = ProcessInfo(pid=os.getpid())
            started = datetime.now(UTC).isoformat(timespec="milliseconds")
            folder.write_info(
                ApplianceInfo(
                    self._plant,
                    progress.file,
                    self.stations,
                    started,
                    os.getpid(),
                    engine=process,
                    services=process,
                )
            )
            self._listener = stack.enter_context(socket.socket(socket.AF_UNIX))
            self._listener.bind(str(folder.control_socket))
            folder.control_socket.chmod(0o600)
            self._listener.listen()
            self._thread = threading.Thread(target=self._serve, daemon=True)
            self._thread.start()
            self._stack = stack.pop_all()

    def close(self) -> None:
        """Remove the folder and close the socket."""
        # close() alone would leave accept() waiting in its thread.
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._stack.close()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            # A client that stays connected delays no other one.
            threading.Thread(target=self._converse, args=(connection,), daemon=True).start()

    def _converse(self, connection: socket.socket) -> None:
        with connection, connection.makefile("rb") as lines, suppress(OSError):
            while line := lines.readline(MAX_LINE):
                connection.sendall(self._answer(line))

    def _answer(self, line: bytes) -> bytes:
        try:
            request = decode_request(line)
        except ControlError as exc:
            return encode_error(request_id(line), exc)
        method = self._methods.get(request.method)
        if method is None:
            reason = f"{request.method}: a replay has no station that does it"
            error = ControlError(reason, code=ErrorCode.UNKNOWN_METHOD)
            return encode_error(request.id, error)
        return encode_result(request.id, method(request.params))

    def _hello(self, params: dict[str, Any]) -> Any:
        del params
        return Hello(
            version=VERSION,
            release=RELEASE,
            plant=self._plant,
            pid=os.getpid(),
            stations=self.stations,
        )

    def _stopped(self, params: dict[str, Any]) -> Any:
        del params
        self._stop()
        return {"stopping": True}

    def _status(self, params: dict[str, Any]) -> Any:
        del params
        process = {"pid": os.getpid(), "restarts": 0}
        return {
            "version": VERSION,
            "plant": self._plant,
            "processes": {"supervisor": process, "engine": process, "services": process},
            "stations": [self._station(name) for name in self.stations],
            "findings": [
                {
                    "severity": "warning",
                    "where": name,
                    "what": self._what(),
                    "advice": "receivers get recorded values; end it with Ctrl-C there",
                    "since": None,
                    "plant": self._plant,
                }
                for name in self.stations
            ],
        }

    def _what(self) -> str:
        progress = self._progress
        loop = f", round {progress.rounds + 1}" if progress.is_loop else ""
        return (
            f"replayed from {progress.file}, {progress.rate:g} times as fast, at"
            f" {progress.position_s:.1f} of {progress.seconds:.1f} s{loop}"
        )

    def _station(self, name: str) -> dict[str, Any]:
        own = [each for each in self._plan.senders.values() if station_name(each.station) == name]
        progress = self._progress
        return {
            "name": name,
            "net_id": own[0].publisher,
            "state": "OP",
            "cycle": 0,
            "cycle_us": 0,
            "cycle_age_us": 0,
            "overruns": 0,
            "restarts": 0,
            "torn": 0,
            "lateness_us": NO_JITTER,
            "ports": [_port(each) for each in own],
            "discarded": {},
            "frames": [],
            "pd": {"tx": list(self._sent(own)), "rx": []},
            "replayed": {
                "file": progress.file,
                "rate": progress.rate,
                "loop": progress.is_loop,
                "position_s": progress.position_s,
                "seconds": progress.seconds,
                "rounds": progress.rounds,
            },
        }

    def _sent(self, own: list[ReplaySender]) -> Any:
        publishers = {each.publisher: each for each in own}
        for key, count in dict(self._progress.sent).items():
            publisher, destination, names = key
            if publisher in publishers:
                for name in names or (destination,):
                    yield {
                        "name": name,
                        "port": publishers[publisher].port,
                        "frame": "",
                        "sent": count,
                        "skipped": 0,
                        "reason": {"replay": count},
                        "last_reason": "replay",
                        "var_state": 0,
                        "frame_state": 0,
                        "subscriber": "unknown",
                    }


def _port(sender: ReplaySender) -> dict[str, Any]:
    return {
        "name": sender.port,
        "kind": "eap",
        "net_id": sender.publisher,
        "interface": sender.interface,
        "link": "up",
    }
