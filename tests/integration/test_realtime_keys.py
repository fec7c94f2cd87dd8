"""Key ``realtime`` of a plant file, in a running appliance."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from typing import Any

import pytest

from tests.support.appliance import Appliance, Plants, wait_until

pytestmark = pytest.mark.net

PLANT = """\
plant: groups
realtime: {groups: 2}
defaults: {cycle_us: 4000}
stations:
""" + "".join(
    f"""\
  - name: s{number}
    net_id: 127.9.61.{number}.1.1
    ports: [{{name: eap0, kind: eap, interface: "udp://127.9.61.{number}", net_id: 127.9.61.{number}.2.1}}]
    variables: {{count: UDINT}}
    sources: {{count: {{kind: counter}}}}
    frames: [{{name: out, port: eap0, to: s{number % 5 + 1}/eap0}}]
    publish: [{{name: count, frame: out, id: {number}, variables: [count]}}]
    subscribe:
      - {{name: count, port: eap0, from: s{(number - 2) % 5 + 1}/count, variables: {{seen: UDINT}}}}
"""  # noqa: E501
    for number in range(1, 6)
)


@pytest.fixture(scope="module")
def appliance(module_farm: Plants) -> Iterator[Appliance]:
    appliance = module_farm.start(module_farm.write(PLANT))
    appliance.wait_ready()
    yield appliance
    appliance.stop()


def groups(appliance: Appliance) -> list[tuple[int, int, list[str]]]:
    found = appliance.status()["processes"]["engine"]["groups"]
    return [(each["cycle_us"], each["phase_us"], each["stations"]) for each in found]


def test_stations_begin_in_the_groups_of_the_plant_file(appliance: Appliance) -> None:
    assert groups(appliance) == [(4000, 0, ["s1", "s3", "s5"]), (4000, 2000, ["s2", "s4"])]


def test_status_shows_groups_and_when_their_last_stations_begin(appliance: Appliance) -> None:
    def found() -> list[int]:
        return [each["last_us"] for each in appliance.status()["processes"]["engine"]["groups"]]

    wait_until(lambda: all(found()))
    assert [each < 4000 for each in found()] == [True, True]
    lines = appliance.command("status", "--full").splitlines()
    first = lines.index("Group of cycle  Begins at  Stations  Last station after") + 2
    assert [line.split()[:2] for line in lines[first : first + 2]] == [["4.0", "ms"]] * 2


def test_stations_of_both_groups_receive_from_each_other(appliance: Appliance) -> None:
    def rows() -> list[dict[str, Any]]:
        return [row for each in appliance.status()["stations"] for row in each["pd"]["rx"]]

    wait_until(lambda: all(row["received"] > 20 for row in rows()))
    assert [row["lost"] for row in rows()] == [0] * 5


def test_groups_stay_as_they_are_over_a_restart_of_the_engine(appliance: Appliance) -> None:
    before, pid = groups(appliance), appliance.pid("engine")
    os.kill(pid, signal.SIGKILL)
    appliance.wait_for_another("engine", pid)
    wait_until(lambda: all(each["restarts"] for each in appliance.status()["stations"]))
    assert groups(appliance) == before


SPINNING = PLANT.replace("{groups: 2}", "{spin: true}").replace("127.9.61.", "127.9.62.")


def test_engine_of_a_spinning_plant_takes_most_of_a_processor(farm: Plants) -> None:
    appliance = farm.run(farm.write(SPINNING))

    def engine() -> dict[str, Any]:
        return appliance.status()["processes"]["engine"]

    assert engine()["realtime"]["spins"] is True
    # It shares the processor with other tests; one that sleeps takes some percent.
    wait_until(lambda: engine()["cpu"] > 25)


def test_spinning_plant_is_refused_on_a_single_processor(farm: Plants) -> None:
    only = str(min(os.sched_getaffinity(0)))
    refused = farm.start(farm.write(SPINNING), prefix=("taskset", "-c", only))
    code, out, err = refused.finish()
    assert (code, out) == (2, "")
    assert err.endswith(
        "realtime.spin cannot be used: the engine would take the only processor that this"
        " appliance has; remove the key, or allow it a second one\n"
    )
