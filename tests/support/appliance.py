"""``eapctl run`` as a process of the test: started, asked, killed in parts, ended."""

from __future__ import annotations

import json
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Self
from unittest import mock

from click.testing import CliRunner

from eap.cli.group import main as eapctl
from eap.errors import ControlError
from eap.ops.client import connect_those
from eap.runtime.folder import VARIABLE
from tests.support import preloaded

EAPCTL = [sys.executable, "-m", "eap"]
READY_S = 90.0
_PROGRESS = re.compile(r"^supervisor: .* has been starting for .*\n", re.MULTILINE)
"""Lines of a start that takes long, as on a busy machine."""


class Appliance:
    """A running appliance with a runtime directory of its own, wherever its network is.

    Unless it *is_real* its processes are forked, see :mod:`tests.support.preloaded`.
    """

    def __init__(
        self,
        plant: Path | None,
        *arguments: str,
        runtime: Path,
        prefix: Sequence[str] = (),
        state: Path | None = None,
        is_real: bool = False,
    ) -> None:
        self.runtime = runtime
        self._prefix = prefix
        self._state = {"EAP_STATE_DIR": str(state)} if state else {}
        words = [str(plant), *arguments] if plant else arguments
        self.process: subprocess.Popen[str] = start_eapctl(
            "run",
            *words,
            prefix=prefix,
            is_real=is_real,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=self._environment(),
            text=True,
        )
        self._logged = b""

    def wait_ready(self) -> list[str]:
        """Return the stations of the ready line."""
        assert self.process.stdout is not None
        waiting, _, _ = select.select([self.process.stdout], [], [], READY_S)
        line = self.process.stdout.readline() if waiting else ""
        if not line:
            self.process.kill()
            raise AssertionError(f"not ready: {self.process.communicate()[1]}")
        ready = json.loads(line)
        assert ready["ready"] is True
        return list(ready["stations"])

    def finish(self, timeout_s: float = 40.0) -> tuple[int, str, str]:
        """Wait for its end; return exit code, stdout and stderr without the progress of a start."""
        out, err = self.process.communicate(timeout=timeout_s)
        return self.process.returncode, out, _PROGRESS.sub("", self._logged.decode() + err)

    def log(self) -> str:
        """Return what it has written to stderr so far."""
        assert self.process.stderr is not None
        descriptor = self.process.stderr.fileno()
        while select.select([descriptor], [], [], 0)[0] and (data := os.read(descriptor, 65536)):
            self._logged += data
        return self._logged.decode()

    def stop(self) -> tuple[int, str, str]:
        """End it as a service manager does."""
        self.process.send_signal(signal.SIGTERM)
        return self.finish()

    def close(self) -> None:
        """Make sure that nothing of it is left."""
        self.process.kill()
        self.process.communicate()

    def command(self, *words: str) -> str:
        """Return the stdout of ``eapctl`` with *words*, which sees no other appliance.

        Any exit code but 0 fails the test, with stderr as the reason: where a failure is expected,
        use :func:`run_eapctl`.
        """
        done = run_eapctl(self.runtime, *words)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def request(self, method: str, **params: Any) -> Any:
        """Ask over the control protocol: much cheaper than a command, for what is asked often."""
        pid = self.process.pid
        with mock.patch.dict(os.environ, {VARIABLE: str(self.runtime)}):
            clients = connect_those(lambda info: bool(self._prefix) or info.supervisor == pid)
        (client,) = clients
        with client:
            return client.request(method, **params)

    def status(self) -> dict[str, Any]:
        """Return the whole status."""
        document: dict[str, Any] = self.request("status")
        return document

    def station(self, name: str) -> dict[str, Any]:
        """Return the status of one station."""
        return next(s for s in self.status()["stations"] if s["name"] == name)

    def rx(self, station: str, pd: str) -> dict[str, Any]:
        """Return the status of one subscription."""
        return next(rx for rx in self.station(station)["pd"]["rx"] if rx["name"] == pd)

    def tx(self, station: str, pd: str) -> dict[str, Any]:
        """Return the status of one PD to send."""
        return next(tx for tx in self.station(station)["pd"]["tx"] if tx["name"] == pd)

    def values(self, station: str) -> dict[str, Any]:
        """Return all variables of a station."""
        values: dict[str, Any] = self.request("read", station=station)["values"]
        return values

    def pid(self, process: str) -> int:
        """Return the process id of ``engine``, ``services`` or ``supervisor``."""
        return int(self.status()["processes"][process]["pid"])

    def wait_for_another(self, process: str, pid: int) -> None:
        """Wait until *process*, which was *pid* and was killed, runs again."""
        wait_until(lambda: self._pid_or_0(process) not in {0, pid})
        if process == "engine":
            before = self._cycles()
            wait_until(lambda: self._cycles() != before)

    def _cycles(self) -> list[int]:
        return [station["cycle"] for station in self.status()["stations"]]

    def _pid_or_0(self, process: str) -> int:
        with suppress(ControlError, ValueError, TypeError):  # nobody answers
            return self.pid(process) or 0
        return 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _environment(self) -> dict[str, str]:
        return os.environ | {VARIABLE: str(self.runtime)} | self._state


def run_eapctl(runtime: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command on the appliances in *runtime*, in this process.

    A process of its own takes a third of a second for its imports: see ``spawn_eapctl``.
    """
    with mock.patch.dict(os.environ, {VARIABLE: str(runtime)}):
        result = CliRunner().invoke(eapctl, words, prog_name="eapctl", catch_exceptions=False)
    return subprocess.CompletedProcess(words, result.exit_code, result.stdout, result.stderr)


def start_eapctl(
    *words: str, prefix: Sequence[str] = (), is_real: bool = False, **options: Any
) -> subprocess.Popen[Any]:
    """Start a command as :class:`subprocess.Popen` does, maybe in a namespace.

    It is forked unless it *is_real*, see :mod:`tests.support.preloaded`.
    """
    is_forked = not is_real and preloaded.is_possible(prefix)
    start = preloaded.start if is_forked else subprocess.Popen
    return start([*prefix, *EAPCTL, *words], **options)


def spawn_eapctl(runtime: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command as a process, where the process itself is what is tested."""
    environment = os.environ | {VARIABLE: str(runtime)}
    return subprocess.run(
        [*EAPCTL, *words], env=environment, capture_output=True, text=True, check=False
    )


class Plants:
    """A short-lived folder for plant files and runtime directories; ends what runs from it.

    Attributes:
        state: Folder of what appliances keep; None for that of the test that starts them.
        is_real: Whether appliances start as programs of their own, which takes four times as long.
    """

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.folder = folder
        self.state: Path | None = None
        self.is_real = False
        self._stack = stack
        self._count = 0

    def write(self, text: str, name: str = "plant.yaml") -> Path:
        """Write a plant file."""
        path = self.folder / name
        path.write_text(text)
        return path

    def start(
        self,
        plant: Path | None,
        *arguments: str,
        prefix: Sequence[str] = (),
        runtime: Path | None = None,
    ) -> Appliance:
        """Start an appliance and return at once; it is alone unless *runtime* is shared."""
        self._count += 1
        folder = runtime or self.folder / f"run{self._count}"
        return self._stack.enter_context(
            Appliance(
                plant,
                *arguments,
                runtime=folder,
                prefix=prefix,
                state=self.state,
                is_real=self.is_real,
            )
        )

    def run(self, plant: Path, *arguments: str, prefix: Sequence[str] = ()) -> Appliance:
        """Start an appliance and wait until it is ready."""
        appliance = self.start(plant, *arguments, prefix=prefix)
        appliance.wait_ready()
        return appliance


class SharedAppliance:
    """One appliance for the tests of a file: started for the first, and after a test that ended it.

    Args:
        start: Starts it and waits until it is ready.
    """

    def __init__(self, start: Callable[[], Appliance]) -> None:
        self._start = start
        self._appliance: Appliance | None = None

    def running(self) -> Appliance:
        """Return the appliance, which runs."""
        if self._appliance is None or self._appliance.process.poll() is not None:
            self._appliance = self._start()
        return self._appliance

    def stop(self) -> None:
        """End it if it runs; the next test that needs it starts it again."""
        if self._appliance is not None and self._appliance.process.poll() is None:
            self._appliance.stop()


@contextmanager
def plants() -> Iterator[Plants]:
    """Make a folder whose paths are short enough for sockets, and clear up afterwards."""
    folder = Path(tempfile.mkdtemp(prefix="eap-"))
    try:
        with ExitStack() as stack:
            yield Plants(folder, stack)
    finally:
        # A page's process looks for its killed supervisor once a second, and may write until then.
        wait_until(lambda: _is_removed(folder))


def _is_removed(folder: Path) -> bool:
    shutil.rmtree(folder, ignore_errors=True)
    return not folder.exists()


def wait_until(condition: Callable[[], object], timeout_s: float = 80.0) -> float:
    """Return the seconds it took until *condition* held.

    Pauses last as long as *condition* takes: what is waited for needs processor time, too.
    """
    start = looked = time.monotonic()
    while not condition():
        now = time.monotonic()
        assert now < start + timeout_s, "did not happen in time"
        time.sleep(max(0.01, now - looked))
        looked = time.monotonic()
    return time.monotonic() - start


def troubles(rx: dict[str, Any]) -> tuple[int, int, int]:
    """Return how many frames of a subscription were lost, duplicated and reordered."""
    return rx["lost"], rx["duplicated"], rx["reordered"]
