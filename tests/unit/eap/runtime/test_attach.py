"""A user program against a real engine in a thread, on a real image in a runtime directory."""

from __future__ import annotations

import queue
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

import msgspec
import pytest

import eap
from eap.codec.times import LongDuration
from eap.engine.channels import PortChannels
from eap.engine.engine_buses import EngineBuses
from eap.engine.rebuild import EngineStation, StationReplacement
from eap.errors import EngineGoneError, ImageError, WriterConflictError
from eap.ids import InterfaceUri, NetId
from eap.net.image_file import ImageFile, create_image, prepare_image
from eap.pd.engine import Engine
from eap.pd.layout import plan_layout
from eap.pd.spec import (
    CounterSource,
    PortKind,
    PortSpec,
    RxPdSpec,
    StationSpec,
    TriggerSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from eap.pd.station import Station
from eap.pd.txframe import EVENT_BIT
from eap.pd.words import StationWord
from eap.runtime import attach as attach_module
from eap.runtime.drop_counters import DropCounters
from eap.runtime.folder import ApplianceFolder, ApplianceInfo
from tests.support.cyclic import OWN, PEER, Wire, octets
from tests.support.eventually import wait_until

pytestmark = pytest.mark.net  # threads and real time

CYCLE_US = 2000
AXIS = "ST_Axis<24/8:x@0 LREAL,state@8 E_State<INT:Off=0,On=1>,at@16 LTIME>"


def spec(*more: VariableSpec) -> StationSpec:
    return StationSpec(
        name="mixer",
        net_id=NetId.parse("1.1.1.1.1.1"),
        cycle_us=CYCLE_US,
        ports=(),
        variables=(
            VariableSpec("ticks", "UDINT", Writer.ENGINE),
            VariableSpec("setpoint", "UINT", default=7),
            VariableSpec("mode", "USINT"),
            *more,
        ),
        sources=(CounterSource("ticks"),),
    )


class Runner:
    """Runs an engine on an image until told to stop."""

    def __init__(self, path: Path, station: StationSpec) -> None:
        file = create_image(path, plan_layout(station))
        self._counters = DropCounters(path.parent / "counts", [station.name])
        channels = PortChannels(self._counters, {})
        self._place = EngineStation(Station(station, file.image, file.wake_waiters), file, channels)
        self._engine = Engine([self._place.station])
        self.successors: queue.SimpleQueue[StationReplacement] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        wait_until(lambda: self.file.image.words[0])

    def _run(self) -> None:
        self._engine.start(time.monotonic_ns())
        while not self._stop.wait(0.0005):
            self._engine.handle_timeout(time.monotonic_ns())
            if not self.successors.empty():
                self.successors.get().take_over(self._engine, time.monotonic_ns())

    @property
    def file(self) -> ImageFile:
        """The image in use."""
        return self._place.file

    def configure(self, station: StationSpec) -> None:
        """Run another specification soon."""
        self.successors.put(StationReplacement(self._place, station, EngineBuses({}, Engine([]))))

    @property
    def station(self) -> Station:
        """Plant that it runs."""
        return self._place.station

    def pause(self) -> None:
        """Run no more cycles."""
        self._stop.set()
        self._thread.join()

    def stop(self) -> None:
        self.pause()
        self.file.close()
        self._counters.close()


@contextmanager
def running(path: Path, station: StationSpec) -> Iterator[Runner]:
    runner = Runner(path, station)
    try:
        yield runner
    finally:
        runner.stop()


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path / "run"))
    with ApplianceFolder.claim("plant") as folder:
        folder.write_info(
            ApplianceInfo(
                plant="plant",
                plant_file="plant.yaml",
                stations=["mixer"],
                started_at="2026-01-01T00:00:00+00:00",
                supervisor=1,
            )
        )
        yield folder.image("mixer")


def test_attach_reads_defaults_and_computed_values(path: Path) -> None:
    with running(path, spec()), eap.attach("mixer") as station:
        assert station.name == "mixer"
        assert station["setpoint"] == 7
        first = station.wait_cycle()
        later = station.wait_cycle()
        assert later > first
        assert station["ticks"] >= later
        assert set(station.read_all()) == {"ticks", "setpoint", "mode"}
        assert station.status()["state"] == "OP"


def test_status_during_cycles_is_of_one_moment(path: Path) -> None:
    pd = RxPdSpec("in", "eap0", 7, ("x",), PEER, step=1)
    out = TxFrameSpec("out", "eap0", "127.9.9.9", (TxPdSpec("p", 1, ("setpoint",)),))
    port = PortSpec("eap0", PortKind.EAP, InterfaceUri.parse("loop://line"), NetId.parse(OWN))
    received = VariableSpec("x", "UINT", Writer.ENGINE)
    whole = msgspec.structs.replace(
        spec(received), ports=(port,), subscriptions=(pd,), frames=(out,)
    )
    with running(path, whole) as runner:
        runner.pause()
        wire = Wire()
        station = runner.station
        wire.handlers = [station.handlers["eap0"]]
        station.connect("eap0", wire)
        end = threading.Event()

        def run_cycles() -> None:
            while not end.is_set():
                now_ns = time.monotonic_ns()
                cycle = station.image.words[StationWord.CYCLE] + 1
                wire.waiting = [(octets([(7, bytes(2))], cycle=cycle & 0xFFFF), now_ns)]
                wire.sent.clear()
                station.cycle(now_ns, now_ns)

        engine = threading.Thread(target=run_cycles)
        before = sys.getswitchinterval()
        sys.setswitchinterval(1e-6)  # each look is interrupted somewhere
        engine.start()
        try:
            with eap.attach("mixer") as attached:
                rows = [attached.status() for _ in range(400)]
        finally:
            end.set()
            engine.join()
            sys.setswitchinterval(before)
    apart = {
        (
            (row["cycle"] - rx["cycle_index"]) & 0xFFFF,
            row["cycle"] - rx["received"],
            row["cycle"] - tx["sent"],
            row["cycle"] - row["frames"][0]["sent"],
        )
        for row in rows
        for (tx,), (rx,) in [(row["pd"]["tx"], row["pd"]["rx"])]
        if rx["received"]
    }
    assert len(apart) == 1


def test_writes_are_seen_together(path: Path) -> None:
    with running(path, spec()), eap.attach("mixer") as station:
        station.write({"setpoint": 500, "mode": 3})
        assert (station["setpoint"], station["mode"]) == (500, 3)
        station["mode"] = 4
        assert station["mode"] == 4


@dataclass
class Axis:
    x: float
    state: int


def test_attach_reads_and_writes_members_of_a_struct(path: Path) -> None:
    axis = VariableSpec("axis", AXIS, default={"x": 1.5, "state": "On", "at": "LTIME#7ns"})
    with running(path, spec(axis)), eap.attach("mixer") as station:
        assert station["axis"] == {"x": 1.5, "state": 1, "at": LongDuration.of(7)}
        station["axis.x"] = 2.5
        station.write({"axis.state": "Off", "mode": 3})
        assert station.read_as("axis", Axis) == Axis(2.5, 0)
        assert station["axis.at"].ns == 7
        value = station["axis"]
        value["at"] = timedelta(microseconds=5)
        station["axis"] = value
        assert station["axis.at"] == timedelta(microseconds=5)
        with pytest.raises(ValueError, match="a value of ST_Axis lacks state, at"):
            station["axis"] = {"x": 1.0}
        with pytest.raises(ImageError, match="ST_Axis has no member 'y'"):
            station["axis.y"] = 1


def test_attach_write_of_unfit_value_writes_nothing(path: Path) -> None:
    with running(path, spec()), eap.attach("mixer") as station:
        with pytest.raises(ValueError, match="70000 is not a value of UINT"):
            station.write({"mode": 9, "setpoint": 70000})
        assert (station["setpoint"], station["mode"]) == (7, 0)


def test_others_variables_are_refused_by_name(path: Path) -> None:
    with running(path, spec()), eap.attach("mixer") as station:
        with pytest.raises(WriterConflictError, match="ticks is written by the engine") as caught:
            station["ticks"] = 1
        assert caught.value.holder == "engine"


def test_unknown_names_suggest_the_near_one(path: Path) -> None:
    with running(path, spec()), eap.attach("mixer") as station:
        with pytest.raises(ImageError, match="did you mean setpoint"):
            station["setpiont"]
        with pytest.raises(ImageError, match=r"no variable 'xyzzy'$"):
            station["xyzzy"]


def test_attach_fire_requires_event_trigger(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attach_module, "_GONE_AFTER_S", 60.0)  # nobody runs this image
    pds = (
        TxPdSpec("state", 1, ("mode",)),
        TxPdSpec("alarm", 2, ("mode",), trigger=TriggerSpec(event=True)),
    )
    sender = msgspec.structs.replace(
        spec(),
        ports=(
            PortSpec(
                "eap0",
                PortKind.EAP,
                InterfaceUri.parse("udp://127.9.3.9"),
                NetId.parse("1.1.1.1.2.1"),
            ),
        ),
        frames=(TxFrameSpec("out", "eap0", "127.9.3.8", pds),),
    )
    with create_image(path, plan_layout(sender)), eap.attach("mixer") as station:
        station.fire("alarm")
        assert station["alarm.VarCtrl"] == EVENT_BIT
        for name in ("state", "alram"):
            with pytest.raises(ImageError, match=f"no PD '{name}' by event.*: alarm$"):
                station.fire(name)


def test_unknown_station_names_the_running_ones(path: Path) -> None:
    with pytest.raises(ImageError, match=r"no station 'mixr' runs here \(running: mixer;"):
        eap.attach("mixr")
    assert not path.exists()


def test_station_of_two_plants_must_be_chosen(path: Path) -> None:
    with ApplianceFolder.claim("twin") as twin, running(path, spec()):
        twin.write_info(
            ApplianceInfo("twin", "twin.yaml", ["mixer"], "2026-01-01T00:00:00+00:00", 1)
        )
        with pytest.raises(ImageError, match="runs in plant, twin: choose one with plant="):
            eap.attach("mixer")
        with eap.attach("mixer", plant="plant") as station:
            assert station.name == "mixer"


def test_attach_without_engine_raises(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attach_module, "_GONE_AFTER_S", 0.1)
    runner = Runner(path, spec())
    with eap.attach("mixer") as station:
        runner.stop()
        with pytest.raises(EngineGoneError, match=r"station mixer: its engine has not run"):
            station.wait_cycle()
        with pytest.raises(EngineGoneError):
            station["setpoint"]


def test_an_engine_that_has_not_run_yet_is_waited_for(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with create_image(path, plan_layout(spec())) as file, eap.attach("mixer") as station:
        assert file.image.words[StationWord.CYCLE_AT_NS] == 0
        assert station["setpoint"] == 7
        monkeypatch.setattr(attach_module, "_GONE_AFTER_S", 0.1)
        with pytest.raises(EngineGoneError, match=r"has not run its first cycle for \d+\.\d s"):
            station.wait_cycle()


def test_moves_to_a_new_layout_and_stays_the_writer(path: Path) -> None:
    first = Runner(path, spec())
    with eap.attach("mixer") as station:
        station["mode"] = 1
        first.stop()
        with running(path, spec(VariableSpec("extra", "INT", default=-5))) as second:
            assert second.file.generation == 2
            assert station["extra"] == -5
            station["extra"] = 12
            assert second.file.image.read("extra") == 12


def test_no_write_and_no_cycle_is_lost_while_the_station_is_changed(path: Path) -> None:
    layouts = [spec(), spec(VariableSpec("extra", "INT", default=-5))]
    with running(path, layouts[0]) as runner, eap.attach("mixer") as station:
        cycle = station.wait_cycle()
        for number in range(1, 61):
            if runner.successors.empty() and not number % 2:
                runner.configure(layouts[number // 2 % 2])
            station["setpoint"] = number
            assert station["setpoint"] == number
            following = station.wait_cycle()
            assert following > cycle
            cycle = following
            assert station["setpoint"] == number
        assert runner.file.generation > 20
        assert runner.file.image.read("setpoint") == 60


def test_attach_finds_image_of_engine_that_died_during_replacement(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(attach_module, "_GONE_AFTER_S", 0.1)
    first = Runner(path, spec())
    with eap.attach("mixer") as station:
        first.stop()
        fresh = prepare_image(path, plan_layout(spec(VariableSpec("extra", "INT"))), 2)
        fresh.move_to(path)  # and then the engine was killed
        fresh.close()
        with running(path, spec(VariableSpec("extra", "INT"))):

            def is_found() -> bool:
                with suppress(ImageError):
                    return station["extra"] == 0
                return False

            wait_until(is_found)
