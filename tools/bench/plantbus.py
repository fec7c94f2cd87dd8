"""A bus in a running plant: process data beside commands that talk to every slave."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

from eap.runtime.folder import VARIABLE
from tools.bench import buses, machine
from tools.bench.appliance import running, status
from tools.bench.buses import PORT, STATION
from tools.bench.cycle import CYCLE_US, OCTETS, PRIORITY, SLAVES
from tools.bench.figures import Figure, at_most, report
from tools.bench.machine import ProcessSample
from tools.bench.network import Cable, Page, cable
from tools.bench.pacing import wait
from tools.bench.settings import Settings
from tools.bench.simulator import simulator

TITLE = "The same in a running plant: requests come from other processes, by way of services"
_UP_WITHIN_S = 20
_SETTLE_S = 1.0


def run(settings: Settings) -> list[Figure]:
    """Measure with and without; raise SkippedError without root or a second core."""
    machine.require_cores()
    settings.tell(f"a bus in a plant, twice {settings.cycle_s:.0f} s")
    with ExitStack() as stack:
        link = stack.enter_context(cable())
        bus, plant = link.folder / "bus.yaml", link.folder / "plant.yaml"
        bus.write_bytes(buses.encode(buses.bus(SLAVES, OCTETS)))
        interface = f"ethernet://{link.interface(0)}"
        plant.write_bytes(buses.encode(buses.plant(interface, CYCLE_US, bus=bus.name)))
        segment = stack.enter_context(simulator(link, bus))
        segment.pin(machine.cores()[1], PRIORITY)
        environment = stack.enter_context(running(plant, link))
        _wait_up(link, environment)
        quiet = _observe(link, environment, settings.cycle_s)
        busy = _observe_busy(link, environment, settings.cycle_s)
    return figures(quiet, busy)


def figures(quiet: dict[str, Any], busy: dict[str, Any]) -> list[Figure]:
    """Compare what happened without and with requests."""
    cycles = f"of {busy['cycles']}"
    late = ", ".join(f"{key} {value} µs" for key, value in busy["lateness_us"].items())

    def both(name: str, key: str, form: str = "d") -> Figure:
        return report(
            f"{name}, with and without requests", f"{busy[key]:{form}} and {quiet[key]:{form}}"
        )

    return [
        at_most("cycles with a wrong working counter", busy["wkc_errors"], 0, " ", cycles),
        report(
            "requests meanwhile",
            f"{busy['octets'] / 1e6:.1f} MB written, {busy['reads']} objects read",
        ),
        both("cycles left out", "overruns"),
        both("cycles without an answer", "lost"),
        both("engine, share of one core", "cpu", ".0%"),
        report("lateness, since the start", late),
        report("longest trip of process data, since the start", f"{busy['max_trip_us']} µs"),
    ]


def _wait_up(link: Cable, environment: dict[str, str]) -> None:
    """Wait until all slaves are in OP; raise RuntimeError if they do not get there."""
    for _ in range(_UP_WITHIN_S):
        wait(1.0)
        bus = _bus(status(link, environment))
        if [slave["state"] for slave in bus.get("slaves", [])] == ["OP"] * SLAVES:
            return
    raise RuntimeError(f"the bus of the plant does not come up: {bus}")


def _observe_busy(link: Cable, environment: dict[str, str], seconds: float) -> dict[str, Any]:
    page = Page(link.folder / "page")
    job = {
        "page": str(link.folder / "page"),
        "runtime": environment[VARIABLE],
        "station": STATION,
        "port": PORT,
        "size": buses.FILE_SIZE,
    }
    with ExitStack() as stack:
        workers = [
            stack.enter_context(link.worker(f"running_roles.{role}", job, side=0, cpu=cpu))
            for role, cpu in zip(("read_objects", "write_files"), machine.cores(), strict=True)
        ]
        for worker in workers:
            worker.answer()
        wait(_SETTLE_S)
        seen = _observe(link, environment, seconds)
        page.words[Page.STOP] = 1
        for worker in workers:
            seen |= worker.answer()
    return seen


def _observe(link: Cable, environment: dict[str, str], seconds: float) -> dict[str, Any]:
    first = status(link, environment)
    pid = int(first["processes"]["engine"]["pid"])
    before_ns = ProcessSample(pid).cpu_ns
    wait(seconds)
    cpu = (ProcessSample(pid).cpu_ns - before_ns) / seconds / 1e9
    last = status(link, environment)
    (old,), (new,) = first["stations"], last["stations"]
    bus = _bus(last)
    return {
        "cpu": cpu,
        "overruns": new["overruns"] - old["overruns"],
        "lateness_us": new["lateness_us"],
        "max_trip_us": bus["max_trip_us"],
        **{key: bus[key] - _bus(first)[key] for key in ("cycles", "wkc_errors", "lost")},
    }


def _bus(document: dict[str, Any]) -> dict[str, Any]:
    (port,) = document["stations"][0]["ports"]
    found: dict[str, Any] = port.get("bus", {})
    return found
