"""Runs beside island-01 of config/demo.yaml: follows what the station receives, writes a setpoint.

eapctl run config/demo.yaml &
python docs/examples/thermostat.py --cycles 200
"""

from __future__ import annotations

import argparse
import sys

import eap
from eap.errors import ImageError


def main() -> int:
    """Raise the setpoint while the neighbour's load is low, in step with the station's cycle."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--station", default="island-01")
    parser.add_argument("--cycles", type=int, default=200)
    options = parser.parse_args()
    try:
        with eap.attach(options.station) as station:
            for _ in range(options.cycles):
                values = station.read_all()
                station["setpoint"] = (values["setpoint"] + 1) % 1000
                cycle = station.wait_cycle()
                if cycle % 50 == 0:
                    print(f"cycle {cycle}: setpoint {values['setpoint']}")
    except ImageError as exc:
        print(exc, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
