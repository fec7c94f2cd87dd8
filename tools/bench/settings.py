"""Duration and number of measurements."""

from __future__ import annotations

import sys
from time import monotonic

import msgspec


class Settings(msgspec.Struct, frozen=True):
    """The durations of one run, in seconds unless the name says otherwise."""

    rounds: int = 5
    throughput_s: float = 0.6
    latency_s: float = 2.0
    lateness_s: float = 6.0
    solar_s: float = 20.0
    search_s: float = 4.0
    cycle_s: float = 20.0
    micro_repeats: int = 7
    started: float = msgspec.field(default_factory=monotonic)

    def tell(self, what: str) -> None:
        """Say on stderr what is being measured now."""
        print(f"[{monotonic() - self.started:5.0f} s] {what}", file=sys.stderr, flush=True)


def quick() -> Settings:
    """Return durations that show whether everything works, and roughly how fast it is."""
    return Settings(
        rounds=2,
        throughput_s=0.3,
        latency_s=0.5,
        lateness_s=1.5,
        solar_s=3.0,
        search_s=1.5,
        cycle_s=3.0,
        micro_repeats=3,
    )
