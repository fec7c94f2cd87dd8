"""A file for a slave by ADS: stored and fetched by pyads, at its own station and through others."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import msgspec

from tools.bench import machine
from tools.bench.appliance import running
from tools.bench.figures import Figure, SkippedError, report
from tools.bench.network import ROOT, Worker
from tools.bench.settings import Settings

TITLE = "FoE by ADS: 1 MB stored and fetched by pyads in blocks, over loopback"
SIZE = 1_000_000
STATIONS = ("first", "second", "last")
ADDRESSES = {name: f"127.0.9.{number}" for number, name in enumerate(STATIONS, 41)}
_DRIVE = ROOT / "config" / "buses" / "drive.yaml"


def run(settings: Settings) -> list[Figure]:
    """Measure through two hops and without any; raise SkippedError without pyads."""
    if importlib.util.find_spec("pyads") is None:
        raise SkippedError("needs pyads")
    with TemporaryDirectory(dir=machine.memory_folder()) as name, ExitStack() as stack:
        path = Path(name) / "files.yaml"
        path.write_text(plant(), encoding="utf-8")
        for station in reversed(STATIONS):
            stack.enter_context(running(path, None, "--station", station))
        rounds = []
        for number in range(settings.rounds):
            settings.tell(f"a file by ADS, round {number + 1} of {settings.rounds}")
            rounds.append((_transfer("first"), _transfer("last")))
    return [figure for way in ("stored", "fetched") for figure in rates(way, rounds)]


def rates(way: str, rounds: Sequence[tuple[dict[str, float], dict[str, float]]]) -> list[Figure]:
    """Say how fast a file is *stored* or *fetched* through two hops, and without."""
    far, near = (median(SIZE / each[end][way] / 1e6 for each in rounds) for end in (0, 1))
    ratio = f"{far:.2f} MB/s, {far / near:.2f} of the {near:.2f} MB/s at the slave's own station"
    return [report(f"1 MB {way} through two hops", ratio, far)]


def plant() -> str:
    """Return a plant of three stations in a row; the last one has the slave."""
    stations = []
    for name, address in ADDRESSES.items():
        stations.append(f"""\
  - name: {name}
    net_id: {address}.1.1
    access: [{{allow: [all]}}]
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{address}", net_id: {address}.2.1}}
""")
    last = ADDRESSES["last"]
    stations[0] += "    routes: [{to: last, via: second/eap0}]\n"
    stations[2] += (
        f'      - {{name: bus0, kind: bus, interface: "sim://{_DRIVE}", net_id: {last}.3.1}}\n'
    )
    return f"plant: files\ndefaults: {{cycle_us: 10000}}\nstations:\n{''.join(stations)}"


def _transfer(station: str) -> dict[str, float]:
    job: dict[str, Any] = {
        "address": ADDRESSES[station],
        "net_id": f"{ADDRESSES['last']}.3.1",
        "size": SIZE,
        "cpu": machine.cores()[0],
    }
    text = msgspec.json.encode(job).decode()
    worker = Worker([sys.executable, "-m", "tools.bench.worker", "file_roles.transfer", text])
    try:
        return dict(worker.answer())
    finally:
        worker.close()
