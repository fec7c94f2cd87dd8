"""Traces along a row of namespaces: every hop is named, and the one where the way ends."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import pytest

from tests.integration.test_routes_ethernet import PLANT, Row
from tests.support.appliance import Plants, run_eapctl, wait_until
from tests.support.namespaces import row

pytestmark = [pytest.mark.net, pytest.mark.root]

SLAVE = "c/bus0/1001"
CLOSED = PLANT.replace(
    "access: [{allow: [all], net_ids: [10.88.170.1], transports: [ethernet]}]",
    "access: [{name: nobody, deny: [all], to: [c/bus0]}]",
)


@pytest.fixture(scope="module")
def shared(module_farm: Plants) -> Iterator[Row]:
    with row(4) as namespaces:
        yield Row(module_farm, namespaces)


@pytest.fixture
def line(shared: Row) -> Row:
    shared.plug()
    return shared


def trace(line: Row, *words: str) -> tuple[int, dict[str, Any]]:
    done = run_eapctl(line.appliances["a"].runtime, "trace", SLAVE, "--json", *words)
    return done.returncode, json.loads(done.stdout)


def hops(found: dict[str, Any]) -> list[tuple[str, str, bool]]:
    return [(each["station"], each["transport"], each["opaque"]) for each in found["hops"]]


WHOLE = [("a", "ethernet:eap0", False), ("b", "ethernet:eap1", False), ("c", "", False)]


def test_every_hop_is_named_and_the_one_that_fails(line: Row) -> None:
    for name in "cba":
        line.start(name)
    wait_until(lambda: trace(line)[0] == 0)
    code, found = trace(line)
    assert (code, hops(found), found["why"]) == (0, WHOLE, "")
    assert found["answer"]["ads_state"] == 5
    assert all(each["took_us"] > 0 for each in found["hops"])
    rules = [each["may"]["write"] for each in found["hops"]]
    assert rules == [True, False, False], "b and c know the tool, and not the station a"

    line.appliances["c"].close()
    gone = "b: c (", "c: it does not answer b at "
    wait_until(lambda: trace(line)[1]["why"].startswith(gone))
    code, found = trace(line)
    assert (code, found["answer"]) == (1, None)
    assert hops(found)[:2] == WHOLE[:2]
    assert found["why"].startswith(gone)

    line.places[1].ip("link", "set", "west0", "down")
    wait_until(lambda: trace(line)[1]["why"].startswith("a: b ("))  # and not c, dead as well
    runtime = line.appliances["a"].runtime
    tested = run_eapctl(runtime, "routes", "test", "a", "c", "--json")
    assert json.loads(tested.stdout)["text"].startswith("b (")
    read = run_eapctl(runtime, "od", "read", SLAVE, "1018:01")
    assert f"{SLAVE}: " in read.stderr
    assert ": a: b (" in read.stderr
    stations = json.loads(run_eapctl(runtime, "scan", "--json").stdout)["stations"]
    assert [each["error"][:6] for each in stations] == ["", "a: b (", "a: b ("]
    log = line.appliances["a"].stop()[2]
    assert " c (" not in log
    lines = [each for each in log.splitlines() if "interface east0 has no link" in each]
    assert lines
    seconds = [re.search(r"; repeated (?:once|\d+ times) in (\d+) s$", each) for each in lines]
    first = [line for line, repeat in zip(lines, seconds, strict=True) if not repeat]
    # Of the request that finds the link down, and of those that are refused because it is.
    assert len(first) in {1, 2}
    assert all(": b (" in each for each in first)
    # One line a minute, and one at the end: three commands asked by the dead hop.
    repeats = [int(each[1]) for each in seconds if each]
    assert repeats
    assert all(each >= 60 for each in repeats[:-1])


def test_rules_that_refuse_are_named(line: Row) -> None:
    for name in "cba":
        line.start(name, CLOSED if name == "c" else PLANT)
    wait_until(lambda: len(trace(line)[1]["hops"]) == 3)
    code, found = trace(line)
    assert code == 1
    assert found["hops"][2]["may"]["read"] is False
    assert found["why"] == "c: error 0x723 (access rules forbid it)"
