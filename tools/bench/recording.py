"""Recording of frames and values: CPU of the recorder, losses, and the engine beside it."""

from __future__ import annotations

import subprocess
from contextlib import nullcontext
from os import geteuid
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec

from tools.bench import machine
from tools.bench.appliance import command_in, running, status
from tools.bench.figures import Figure, at_most, report
from tools.bench.machine import ProcessSample, memory_folder
from tools.bench.network import ROOT, Cable, cable
from tools.bench.pacing import wait
from tools.bench.plants import many_values
from tools.bench.settings import Settings

TITLE = "recording: all frames of the solar line, and 200 variables at 1 kHz, each by one recorder"
SOLAR = ROOT / "config" / "solar-line.yaml"
VALUES = 200
_WARM_UP_S = 2.0
_MEGA = 1 << 20


class RecordedRun(msgspec.Struct, frozen=True):
    """One run of a plant, with a recorder or without.

    Attributes:
        engine: Share of a core of the engine.
        recorder: The same of the recorder.
        rss: Bytes of the recorder.
        lateness_us: Of the station that was worst.
        state: Of the recording at its end.
    """

    engine: float
    lateness_us: dict[str, int]
    recorder: float = 0.0
    rss: int = 0
    state: dict[str, Any] = {}


def run(settings: Settings) -> list[Figure]:
    """Record both plants; as root in a namespace of their own."""
    machine.require_cores()
    figures: list[Figure] = []
    with TemporaryDirectory(dir=memory_folder()) as folder:
        plant = Path(folder, "values.yaml")
        plant.write_bytes(many_values(VALUES, 1000))
        for name, path, words in (
            ("frames", SOLAR, ["--frames"]),
            ("values", plant, ["--values"]),
        ):
            settings.tell(f"recording {name} for {settings.solar_s:.0f} s, and the plant without")
            with cable() if geteuid() == 0 else nullcontext() as link:
                alone = _observe(path, settings.solar_s, link)
            with cable() if geteuid() == 0 else nullcontext() as link:
                target = Path(folder, name)
                beside = _observe(path, settings.solar_s, link, ["-o", str(target), *words])
            figures += _figures(name, settings.solar_s, alone, beside)
            for left in Path(folder).glob(f"{name}.*"):
                if left != plant:
                    left.unlink()
    return figures


def _figures(name: str, seconds: float, alone: RecordedRun, beside: RecordedRun) -> list[Figure]:
    state = beside.state
    size = state["octets"] / seconds / _MEGA
    late = " · ".join(
        ", ".join(f"{key} {value} µs" for key, value in each.lateness_us.items())
        for each in (alone, beside)
    )
    return [
        at_most(f"{name}, lost", state["lost"], 0, " ", f"of {state['messages']} recorded"),
        at_most(f"{name}, recorder, share of one core", beside.recorder * 100, 15, " %"),
        report(f"{name}, resident memory of the recorder", f"{beside.rss / _MEGA:.0f} MB"),
        report(f"{name}, file", f"{size:.2f} MB/s", size),
        report(
            f"{name}, engine without and with a recorder, share of one core",
            f"{alone.engine:.1%}, {beside.engine:.1%}",
        ),
        report(f"{name}, lateness of the worst station without · with", late),
    ]


def _observe(
    plant: Path, seconds: float, link: Cable | None, record: list[str] | None = None
) -> RecordedRun:
    with running(plant, link) as environment:
        wait(_WARM_UP_S)

        def eapctl(*words: str) -> dict[str, Any]:
            done = subprocess.run(
                command_in(link, "record", *words, "--json"),
                capture_output=True,
                check=True,
                env=environment,
                cwd=ROOT,
            )
            return msgspec.json.decode(done.stdout, type=dict[str, Any])

        state = eapctl("start", *record) if record is not None else {}
        pids = [int(status(link, environment)["processes"]["engine"]["pid"])]
        pids += [state["pid"]] if state else []
        wait(_WARM_UP_S)
        before = [ProcessSample(pid) for pid in pids]
        wait(seconds)
        after = [ProcessSample(pid) for pid in pids]
        if state:
            state = eapctl("stop", state["name"])
        stations = status(link, environment)["stations"]
    shares = [
        (last.cpu_ns - first.cpu_ns) / seconds / 1e9
        for first, last in zip(before, after, strict=True)
    ]
    return RecordedRun(
        engine=shares[0],
        lateness_us={
            key: max(station["lateness_us"][key] for station in stations)
            for key in ("p50", "p99", "max")
        },
        recorder=shares[-1] if state else 0.0,
        rss=after[-1].rss if state else 0,
        state=state,
    )
