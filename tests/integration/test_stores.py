"""Values of a running plant in a real PostgreSQL, over a break of the server."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import Appliance, Plants, run_eapctl, wait_until
from tests.support.postgres import PostgresServer, postgres

psycopg = pytest.importorskip("psycopg", reason="needs psycopg")
pytestmark = pytest.mark.net

PLANT = """\
plant: mill
defaults: {cycle_us: 10000}
stations:
  - name: left-1
    net_id: 127.9.63.1.1.1
    ports: [{name: eap0, kind: eap, interface: "udp://127.9.63.1", net_id: 127.9.63.1.2.1}]
    variables:
      ticks: UDINT
      wave: {type: LREAL, unit: mm}
      note: {type: "STRING(8)", default: "a\\tb"}
    sources:
      ticks: {kind: counter}
      wave: {kind: sine, amplitude: 3.3, period_ms: 700}
    frames: [{name: out, port: eap0, to: 127.9.63.2}]
    publish: [{name: state, frame: out, id: 1, variables: [ticks, wave, note]}]
"""


@pytest.fixture(scope="module")
def server() -> Iterator[PostgresServer]:
    # Beside pytest's folders, which only their owner may enter: the server is another user's.
    folder = Path(tempfile.mkdtemp(dir="/tmp"))
    try:
        with postgres(folder) as found:
            yield found
    finally:
        shutil.rmtree(folder)


@pytest.fixture(scope="module")
def mill(module_farm: Plants) -> Appliance:
    return module_farm.run(module_farm.write(PLANT))


def state(appliance: Appliance, name: str) -> dict[str, Any]:
    lines = appliance.command("record", "list", "--json").splitlines()
    return next(row for row in map(json.loads, lines) if row["name"] == name)


def test_values_are_stored_over_a_break_of_the_server(
    mill: Appliance, server: PostgresServer
) -> None:
    url = server.url.replace("eap@", "eap:secret@")
    mill.command("record", "start", "left-1", "--to", url, "-o", "store")
    wait_until(lambda: state(mill, "store")["messages"] > 50)
    server.stop()
    wait_until(lambda: state(mill, "store")["reason"])
    assert "secret" not in json.dumps(state(mill, "store"))
    server.start()
    stored = state(mill, "store")["messages"]
    wait_until(lambda: state(mill, "store")["messages"] > stored + 50)
    mill.command("record", "mark", "door open")
    ended = json.loads(mill.command("record", "stop", "store", "--json"))
    assert (ended["lost"], ended["not_stored"], ended["state"]) == (0, 0, "ended")
    with psycopg.connect(server.url) as connection:
        rows = connection.execute(
            'SELECT cycle, ticks, wave, note, time_ns FROM mill."left-1" ORDER BY time_ns'
        ).fetchall()
        events = connection.execute("SELECT kind, text FROM mill.recording_events").fetchall()
    cycles = [row[0] for row in rows]
    # Without a gap; a transaction that the break cut may be there twice.
    assert sorted(set(cycles)) == list(range(cycles[0], cycles[-1] + 1))
    assert len({row[1] - row[0] for row in rows}) == 1
    assert len({row[2] for row in rows}) > 20
    assert {row[3] for row in rows} == {"a\tb"}
    assert ended["messages"] <= len(rows)
    assert ("mark", "door open") in events


def test_store_that_does_not_answer_at_the_start_is_an_error(mill: Appliance) -> None:
    done = run_eapctl(mill.runtime, "record", "start", "--to", "postgresql://127.0.0.1:1/x")
    assert done.returncode == 1
    assert "postgresql://127.0.0.1:1/x" in done.stderr
    assert "refused" in done.stderr


def test_other_options_contradict_a_store(mill: Appliance) -> None:
    words = ["record", "start", "--frames", "--to", "postgresql://h/x"]
    assert "--to: a store takes values as they come" in run_eapctl(mill.runtime, *words).stderr
    done = run_eapctl(mill.runtime, "record", "start", "--to", "oracle://h/x")
    assert (done.returncode, "expected a store" in done.stderr) == (2, True)
    assert os.environ.get("EAP_RECORD_TO") is None
