"""An appliance to talk to: a real control server on real images, without an engine."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from time import monotonic_ns

import pytest

from eap.appliance.control import encode_request
from eap.appliance.control_server import ControlServer
from eap.appliance.methods import Methods
from eap.appliance.runtime import ApplianceFolder, ApplianceInfo, ProcessInfo
from eap.appliance.status import ProcessMeter, appliance_status
from eap.net.image_file import ImageFile, create_image
from eap.pd.layout import plan_layout
from eap.pd.spec import (
    PortKind,
    PortSpec,
    RxPdSpec,
    StationSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from eap.pd.words import RxWord, StationWord


def station(name: str) -> StationSpec:
    return StationSpec(
        name=name,
        net_id="1.1.1.1.1.1",
        cycle_us=10_000,
        ports=(PortSpec("eap0", PortKind.EAP, "udp://127.0.9.1", "1.1.1.1.2.1"),),
        variables=(
            VariableSpec("ticks", "UDINT", Writer.ENGINE),
            VariableSpec("setpoint", "INT", default=7, unit="1/min"),
            VariableSpec("curve", "REAL[2]"),
            VariableSpec("level", "INT", Writer.ENGINE),
            VariableSpec("silent", "INT", Writer.ENGINE),
        ),
        frames=(
            TxFrameSpec(
                "to-right", "eap0", "239.1.2.3", (TxPdSpec("state", 101, ("ticks", "setpoint"), 3),)
            ),
        ),
        subscriptions=(
            RxPdSpec("left", "eap0", 102, ("level",), publisher="2.1.1.1.2.1", step=1),
            RxPdSpec("other", "eap0", 103, ("silent",)),
        ),
    )


class Appliance:
    """A plant's folder, images and control server; the server runs in a thread."""

    def __init__(self, plant: str, names: list[str], stack: ExitStack) -> None:
        folder = stack.enter_context(ApplianceFolder.claim(plant))
        self.info = ApplianceInfo(
            plant=plant,
            plant_file=f"{plant}.yaml",
            stations=names,
            started_at="2026-01-01T00:00:00+00:00",
            supervisor=1,
            engine=ProcessInfo(pid=1, restarts=2, report={"realtime": {"scheduler": "fifo 50"}}),
        )
        folder.write_info(self.info)
        self.files = {
            name: stack.enter_context(create_image(folder.image(name), plan_layout(station(name))))
            for name in names
        }
        for file in self.files.values():
            _receive(file)
        self._listener = stack.enter_context(socket.socket(socket.AF_UNIX))
        self._listener.bind(str(folder.control_socket))
        self._listener.listen()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        stack.callback(self.stop)

    def set(self, name: str, variable: str, value: object) -> None:
        """Write a variable as the engine does."""
        image = self.files[name].image
        with image.writing(Writer.ENGINE):
            image.write(variable, value)

    def stop(self) -> None:
        """End the server; clients see their connection close."""
        if self._thread.is_alive():
            self._wait_for_others()
            self._loop.call_soon_threadsafe(self._task.cancel)
            self._thread.join()

    def _wait_for_others(self) -> None:
        """Be served once: by then, whoever connected before has a task that closes its socket."""
        with socket.socket(socket.AF_UNIX) as connection:
            connection.connect(self._listener.getsockname())
            connection.sendall(encode_request(1, "hello", {}))
            connection.recv(1)

    def _run(self) -> None:
        meter = ProcessMeter()
        images = [file.image for file in self.files.values()]
        methods = Methods(
            {"plant": self.info.plant},
            self.files,
            status=lambda: appliance_status(self.info, images, {}, meter),
            stop=lambda: None,
        )
        self._task = self._loop.create_task(ControlServer(methods).serve(self._listener))
        try:
            self._loop.run_until_complete(self._task)
        except asyncio.CancelledError:
            pass
        finally:
            self._loop.run_until_complete(self._loop.shutdown_asyncgens())
            self._loop.close()


def _receive(file: ImageFile) -> None:
    """Leave the traces of 5 PDs taken, the last one 3 cycles ago."""
    image = file.image
    image.words[StationWord.CYCLE] = 1000
    image.words[StationWord.STATE] = 8
    for place in image.layout.rx:
        image.words[place.words + RxWord.ACCOUNT] = place.words
    left = image.layout.rx[0].words
    image.words[left + RxWord.RECEIVED] = 5
    image.words[left + RxWord.ARRIVED_IN_CYCLE] = 997
    image.words[left + RxWord.ARRIVED_AT_NS] = monotonic_ns()


@pytest.fixture
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty runtime directory."""
    root = tmp_path / "run"
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(root))
    return root


@pytest.fixture
def appliance(runtime: Path) -> Iterator[Appliance]:
    """Plant ``line`` with the stations mixer and filler."""
    with ExitStack() as stack:
        yield Appliance("line", ["mixer", "filler"], stack)


@pytest.fixture
def other_appliance(appliance: Appliance) -> Iterator[Appliance]:
    """Plant ``hall`` beside ``line``, with the stations oven and, once more, mixer."""
    with ExitStack() as stack:
        yield Appliance("hall", ["oven", "mixer"], stack)
