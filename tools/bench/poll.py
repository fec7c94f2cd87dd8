"""Cycles between a request and its answer, for a server at any phase of the cycle."""

from __future__ import annotations

from typing import Any

from tools.bench import machine
from tools.bench.figures import Figure, at_most, percentile, report
from tools.bench.network import Cable, Page, cable
from tools.bench.poll_roles import CYCLE_US
from tools.bench.settings import Settings

TITLE = "Poll round trip, client and server at 1 ms over EtherType, two PDs a request"
PHASES_US = (500, 0, 750)
"""Phases of the server after the client: half a cycle, none, and almost a cycle."""
PRIORITY = 50
_COLD = 20
"""Answers left out: they find cold caches."""


def run(settings: Settings) -> list[Figure]:
    """Measure each phase; raise SkippedError without root or a second core."""
    machine.require_cores()
    figures = []
    with cable() as link:
        for phase_us in PHASES_US:
            settings.tell(f"poll, server {phase_us} µs after the client")
            figures += figures_of(phase_us, _measure(link, settings.latency_s, phase_us))
    return figures


def figures_of(phase_us: int, found: dict[str, Any]) -> list[Figure]:
    """Say what the client noted of a server that runs *phase_us* after it."""
    name = f"server {phase_us} µs after the client"
    trips = found["trips"][_COLD:]
    if not trips:
        raise RuntimeError(f"{name}: no answer to {found['asked']} requests")
    tail = f"p99 {percentile(trips, 0.99)}, max {max(trips)}, of {len(trips)} answers"
    response = ", ".join(f"{key} {found['response_us'][key]} µs" for key in ("p50", "p99", "max"))
    # The answer waits for the server's cycle, then for the client's.
    allowed = 1 if 0 < phase_us <= CYCLE_US // 2 else 2
    return [
        at_most(f"{name}: round trip, median", percentile(trips, 0.5), allowed, " cycles", tail),
        report(f"{name}: response, to the socket of the client", response),
    ]


def _measure(link: Cable, seconds: float, phase_us: int) -> dict[str, Any]:
    near, far = machine.cores()
    for left in (link.folder / "page", *link.folder.glob("*.image")):
        left.unlink(missing_ok=True)
    page = Page(link.folder / "page")
    job = {"folder": str(link.folder), "page": str(link.folder / "page"), "priority": PRIORITY}
    server = job | {"interface": link.interface(1), "phase_us": phase_us}
    client = job | {"interface": link.interface(0), "seconds": seconds}
    with link.worker("poll_roles.serve", server, side=1, cpu=far) as serving:
        serving.answer()
        with link.worker("poll_roles.ask", client, side=0, cpu=near) as asking:
            found = asking.answer(seconds)
        page.words[Page.STOP] = 1
    return found
