"""Process data beside mailbox traffic: what the one costs the other."""

from __future__ import annotations

from typing import Any

from tools.bench import buses, machine
from tools.bench.figures import Figure, at_most, report
from tools.bench.network import cable
from tools.bench.settings import Settings
from tools.bench.simulator import simulator

TITLE = "16 slaves, 512 bytes, 1 ms, while 1 MB goes through FoE and SDOs run on every slave"
SLAVES = 16
OCTETS = 512
CYCLE_US = 1000
ACYCLIC_OCTETS = 3000
"""Acyclic budget that a plant gives a bus of 1 ms: three bytes for each microsecond."""
TIMEOUT_MS = 5
"""Frame timeout of a plant."""
PRIORITY = 50


def run(settings: Settings) -> list[Figure]:
    """Measure with and without; raise SkippedError without root or a second core."""
    machine.require_cores()
    near, far = machine.cores()
    job = {
        "cycle_us": CYCLE_US,
        "acyclic_octets": ACYCLIC_OCTETS,
        "timeout_ms": TIMEOUT_MS,
        "priority": PRIORITY,
        "seconds": settings.cycle_s,
        "size": buses.FILE_SIZE,
    }
    settings.tell(f"cycles beside mailboxes, twice {settings.cycle_s:.0f} s")
    with cable() as link:
        path = link.folder / "bus.yaml"
        path.write_bytes(buses.encode(buses.bus(SLAVES, OCTETS)))
        with simulator(link, path) as segment:
            segment.pin(far, PRIORITY)  # slaves are hardware: nobody takes their time
            more = {"interface": link.interface(0)}
            with link.worker("cycle_roles.run", job | more, side=0, cpu=near) as worker:
                return figures(worker.answer(2 * settings.cycle_s))


def figures(answer: dict[str, Any]) -> list[Figure]:
    """Say what the loop noted."""
    busy, quiet = answer["busy"], answer["quiet"]
    if answer["slaves"] != SLAVES:
        raise RuntimeError(f"the master found {answer['slaves']} slaves, there are {SLAVES}")
    cycles = f"of {busy['cycles']}"
    moved = f"{answer['octets'] / 1e6:.1f} MB written, {answer['reads']} objects read"
    return [
        at_most("cycles skipped by mailbox work", busy["skipped_by_work"], 0, " ", cycles),
        at_most("cycles with a wrong working counter", busy["wkc_errors"], 0, " ", cycles),
        at_most("requests that failed", len(answer["errors"]), 0, " ", _first(answer["errors"])),
        report("mailbox traffic meanwhile", moved),
        report(
            "cycles skipped while others had the processor, with and without mailbox traffic",
            f"{busy['skipped'] - busy['skipped_by_work']} and"
            f" {quiet['skipped'] - quiet['skipped_by_work']}",
        ),
        report(f"cycles without an answer within {TIMEOUT_MS} ms, with and without",
               f"{busy['lost']} and {quiet['lost']}"),
        report("answers that came after the next cycle, with and without",
               f"{busy['unanswered']} and {quiet['unanswered']}"),
        report("lateness with mailbox traffic", _times(busy["late_ns"])),
        report("lateness without", _times(quiet["late_ns"])),
        report("trip of process data with mailbox traffic", _times(busy["trip_ns"])),
        report("trip of process data without", _times(quiet["trip_ns"])),
        report("master, share of one core, with and without",
               f"{busy['cpu']:.0%} and {quiet['cpu']:.0%}"),
    ]  # fmt: skip


def _first(errors: list[str]) -> str:
    return errors[0] if errors else ""


def _times(summary: dict[str, int]) -> str:
    return ", ".join(f"{key} {summary[key] / 1000:.0f} µs" for key in ("p50", "p99", "max"))
