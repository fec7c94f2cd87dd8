"""Runs beside island-01 of config/demo.yaml: raises the setpoint while the neighbour runs.

eapctl run config/demo.yaml &
python docs/examples/thermostat.py --cycles 200
"""

from __future__ import annotations

import argparse
import sys

import eap
from eap.errors import EapError

STATION = "island-01"


def main() -> int:
    """Follow what the station receives and write its setpoint, in step with its cycle."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cycles", type=int, default=200)
    options = parser.parse_args()
    try:
        with eap.attach(STATION) as station:
            for count in range(options.cycles):
                values = station.read_all()
                if values["left_running"]:
                    station["setpoint"] = (values["setpoint"] + 1) % 1000
                cycle = station.wait_cycle()
                if count % 50 == 0:
                    print(f"cycle {cycle}: setpoint {values['setpoint']}")
    except EapError as exc:
        print(exc, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        pass
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
