"""An appliance whose messages nobody takes: a held terminal, or a pipe with a sleeping reader."""

from __future__ import annotations

import os
import re
import signal

import pytest

from tests.support.appliance import Appliance, Plants, wait_until

pytestmark = pytest.mark.net

PLANT = """\
plant: held
defaults: {cycle_us: 10000}
stations:
  - name: only
    net_id: 127.9.92.1.1.1
    ports: [{name: eap0, kind: eap, interface: "udp://127.9.92.1", net_id: 127.9.92.1.2.1}]
    variables: {ticks: UDINT}
    sources: {ticks: {kind: counter}}
"""


def fill_stderr(appliance: Appliance) -> None:
    """Write to the pipe that its messages go to until that takes no more."""
    writing = os.open(f"/proc/{appliance.process.pid}/fd/2", os.O_WRONLY | os.O_NONBLOCK)
    try:
        while True:
            os.write(writing, b"." * 512)
    except BlockingIOError:
        pass
    finally:
        os.close(writing)


def test_everything_goes_on(farm: Plants) -> None:
    appliance = farm.run(farm.write(PLANT))
    fill_stderr(appliance)
    for name in ("services", "engine", "services"):
        killed = appliance.pid(name)
        os.kill(killed, signal.SIGKILL)
        wait_until(lambda name=name, killed=killed: appliance.pid(name) not in {0, killed})
    before = appliance.values("only")["ticks"]
    wait_until(lambda: appliance.values("only")["ticks"] > before)
    code, _, errors = appliance.stop()
    assert code == 0
    # From when the test reads on, there is room for a note of what was left out, and more lines.
    rest = errors.rpartition("." * 512)[2].lstrip(".")
    assert not rest or re.match(r"\(\d+ lines? dropped here: the reader was too slow\)\n", rest)
