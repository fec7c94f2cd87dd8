from __future__ import annotations

from devicebus.errors import BusError, MailboxTimeoutError
from devicebus.master.mailstats import Tally


def test_latencies_and_errors():
    tally = Tally()
    nothing = tally.stats(repeats=0, duplicates=0, gaps=0)
    assert (nothing.mean_latency_ns, nothing.last_error) == (0, "")
    for latency in (30, 10, 20):
        tally.answer(latency)
    tally.fail(MailboxTimeoutError("slow"))
    tally.fail(BusError("odd"))
    stats = tally.stats(repeats=1, duplicates=2, gaps=3)
    assert (stats.latency_ns, stats.mean_latency_ns, stats.max_latency_ns) == (20, 20, 30)
    assert (stats.timeouts, stats.errors, stats.last_error) == (1, 1, "odd")
    assert (stats.repeats, stats.duplicates, stats.gaps) == (1, 2, 3)
