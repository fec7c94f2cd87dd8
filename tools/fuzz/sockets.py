"""Damaged messages to every listening socket of a running appliance.

Datagrams, and streams of several messages on connections that stay open, so that what one message
leaves behind meets the next.  Between them a client of each kind asks: a process that ended, or an
answer that does not come, is a find.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from time import monotonic
from typing import Any, NamedTuple, Self

from tools.fuzz.mutator import mutations

HOST = "127.9.99.1"
PLANT = f"""\
plant: fuzzed
stations:
  - name: mill
    net_id: {HOST}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{HOST}", net_id: {HOST}.2.1, tcp: true}}
      - {{name: bus0, kind: bus, interface: "sim://BUS", net_id: {HOST}.3.1}}
    variables: {{speed: REAL, ticks: UDINT}}
    sources: {{ticks: {{kind: counter}}}}
    frames: [{{name: out, port: eap0, to: {HOST}:5}}]
    publish: [{{name: state, frame: out, id: 1, variables: [ticks]}}]
    subscribe:
      - {{name: seen, port: eap0, from: {{publisher: 127.9.99.2.2.1, id: 1}}, foreign: true,
         variables: {{a: UDINT}}}}
"""
DATAGRAMS = (34980, 48899)
STREAMS = (34980, 48898)
CONTROL = 0
"""Stands for the control socket among the ports of streams."""
_BUS = Path(__file__).parents[2] / "config" / "buses" / "buttons.yaml"
_EAPCTL = Path(sys.executable).with_name("eapctl")
_BETWEEN_LOOKS = 2000
_OPEN = 16
"""Connections that are kept open to one socket."""
_KEPT = 200
"""Last inputs that a report has."""
_START_S, _ANSWER_S, _END_S = 60.0, 20.0, 10.0
_LINES = [
    json.dumps({"v": 1, "id": 1, "method": method, "params": params}).encode() + b"\n"
    for method, params in (
        ("status", {}),
        ("values", {"station": "mill"}),
        ("write", {"station": "mill", "values": {"speed": 1.5}}),
        ("export", {"station": "mill"}),
        ("watch", {"station": "mill", "names": ["ticks"], "period_ms": 10}),
        ("routes", {}),
    )
]


class SocketFind(NamedTuple):
    """The last inputs, and what was wrong after them, with the end of the appliance's log."""

    sent: list[bytes]
    text: str


def fuzz_sockets(
    seconds: float, seed: int, seeds: Sequence[bytes]
) -> tuple[int, SocketFind | None]:
    """Send damaged *seeds* for so long; return how many, and the find if there is one."""
    dice = Random(seed)  # noqa: S311  damage, not secrets
    frames, lines = mutations(seeds, dice), mutations(_LINES, dice)
    last: deque[bytes] = deque(maxlen=_KEPT)
    with tempfile.TemporaryDirectory() as folder, FuzzedAppliance(Path(folder)) as appliance:
        end, count = monotonic() + seconds, 0
        while monotonic() < end:
            for _ in range(_BETWEEN_LOOKS):
                port = dice.choice((*DATAGRAMS, *STREAMS, CONTROL))
                data = next(lines if port == CONTROL else frames)
                last.append(data)
                appliance.send(port, data, dice)
                count += 1
            if wrong := appliance.fault():
                return count, SocketFind(list(last), f"{wrong}\n{appliance.log()}")
    return count, None


class FuzzedAppliance:
    """A running appliance and the connections to it; a context manager."""

    processes: dict[str, Any]
    """Rows of ``status`` at the start, by the name of the process."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._log = folder / "log"
        self._open: dict[int, list[socket.socket]] = {}
        self._datagrams = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def __enter__(self) -> Self:
        plant = self._folder / "fuzzed.yaml"
        plant.write_text(PLANT.replace("BUS", str(_BUS)))
        own = {"EAP_RUNTIME_DIR": str(self._folder / "run"), "EAP_STATE_DIR": str(self._folder)}
        self._environment = os.environ | own
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [_EAPCTL, "run", plant],
                env=self._environment,
                stdout=subprocess.PIPE,
                stderr=log,
                start_new_session=True,
            )
        try:
            self._wait_until_ready()
        except BaseException:
            self.__exit__()
            raise
        return self

    def _wait_until_ready(self) -> None:
        assert self._process.stdout is not None  # noqa: S101  PIPE
        if b"ready" not in self._process.stdout.readline():
            raise RuntimeError(f"the appliance did not start: {self.log()}")
        (self._control,) = (self._folder / "run").glob("**/control")
        self.processes = self._status()["processes"]

    def __exit__(self, *_: object) -> None:
        for connections in (*self._open.values(), [self._datagrams]):
            for each in connections:
                each.close()
        self._process.send_signal(signal.SIGTERM)
        try:
            self._process.communicate(timeout=_END_S)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.communicate()

    def send(self, port: int, data: bytes, dice: Random) -> None:
        """Send *data* as a datagram, or on one of the connections to a socket."""
        if port in DATAGRAMS and (port not in STREAMS or dice.random() < 0.5):
            self._try(lambda: self._datagrams.sendto(data, (HOST, port)))
            return
        connections = self._open.setdefault(port, [])
        if len(connections) < _OPEN or dice.random() < 0.01:
            self._try(lambda: connections.append(self._connect(port)))
        if len(connections) > _OPEN:
            connections.pop(0).close()
        if connections:
            chosen = dice.choice(connections)
            if not self._try(lambda: chosen.send(data)):
                connections.remove(chosen)
                chosen.close()

    def fault(self) -> str:
        """Return what is wrong with the appliance, empty if nothing is."""
        if self._process.poll() is not None:
            return f"the appliance ended with {self._process.returncode}"
        try:
            processes = self._status()["processes"]
        except (OSError, ValueError, LookupError, subprocess.SubprocessError) as exc:
            return f"no answer to a status request: {type(exc).__name__}"
        for name, row in processes.items():
            before = self.processes.get(name)
            if isinstance(row, dict) and before and row.get("pid") != before.get("pid"):
                return f"process {name} was started again"
        return "a traceback is in the log" if "Traceback" in self.log() else ""

    def log(self) -> str:
        """Return the end of the appliance's log, without the names of its folders."""
        text = self._log.read_text(errors="replace")[-20_000:]
        return text.replace(str(self._folder), "FOLDER")

    def _status(self) -> Any:
        done = subprocess.run(
            [_EAPCTL, "status", "--json"],
            env=self._environment,
            capture_output=True,
            timeout=_ANSWER_S,
            check=False,
        )
        return json.loads(done.stdout)

    def _connect(self, port: int) -> socket.socket:
        family = socket.AF_UNIX if port == CONTROL else socket.AF_INET
        made = socket.socket(family, socket.SOCK_STREAM)
        made.settimeout(1)
        try:
            made.connect(str(self._control) if port == CONTROL else (HOST, port))
        except OSError:
            made.close()
            raise
        made.setblocking(False)
        return made

    @staticmethod
    def _try(step: Callable[[], object]) -> bool:
        try:
            step()
        except BlockingIOError:
            return True  # it does not read: the rest of its data is lost, as by a slow network
        except OSError:
            return False
        return True
