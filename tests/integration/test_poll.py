"""A client that polls two servers (config/poll.yaml): what it says of answers, what a tap saw."""

from __future__ import annotations

import os
import socket
import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import pytest

import eap
from eap.runtime.folder import VARIABLE
from tests.support.appliance import Appliance, Plants, wait_until
from tests.support.machine import slowness
from tests.support.namespaces import cable
from tests.support.wiretap import Tapped, Wiretap

pytestmark = pytest.mark.net

PLANT = Path(__file__).parents[2] / "config/poll.yaml"
GROUP = "239.88.164.7"
CLIENT_CYCLE_US = 2000
SERVER_CYCLE_US = 10_000
ANSWERS = {"mill-part": [71, 72], "mill-wear": [71, 72], "lathe-part": [71]}
"""By subscription: the PDs of the frame that brings it."""
PUBLISHERS = {
    "mill-part": "127.0.4.2.2.1",
    "mill-wear": "127.0.4.2.2.1",
    "lathe-part": "127.0.4.3.2.1",
}
DESK = "127.0.4.1.2.1"
SAMPLES = 30
"""Three answers to each of 25 requests a second; on a busy host many are seen too late."""
LONGEST_S = 60.0


def over(*, desk: str, mill: str, lathe: str, to: str) -> str:
    """The plant on other interfaces."""
    text = PLANT.read_text()
    for number, interface in enumerate((desk, mill, lathe), 1):
        text = text.replace(f"udp://127.0.4.{number}", interface)
    return text.replace(f"to: {GROUP}", f"to: {to}")


class Sample(NamedTuple):
    """State of a subscription at the client, in the cycle that received an answer."""

    name: str
    cycle_index: int
    quality_us: int
    response_us: int


def sample(appliance: Appliance, count: int) -> list[Sample]:
    """Look at the client once a cycle, and keep what it says where an answer has just come.

    Until there are *count* samples, at most for a while.
    """
    samples = []
    last: dict[str, int] = {}
    with (
        mock.patch.dict(os.environ, {VARIABLE: str(appliance.runtime)}),
        eap.attach("desk") as desk,
    ):
        before, end = 0, time.monotonic() + LONGEST_S
        while len(samples) < count and time.monotonic() < end:
            cycle = desk.wait_cycle()
            status = desk.status()
            # Whoever comes too late for a cycle does not know when the answer was taken.
            on_time = before + 1 == cycle == status["cycle"] == desk.cycle
            before = cycle
            for row in status["pd"]["rx"]:
                index = row["cycle_index"]
                if on_time and last.get(row["name"], index) != index:
                    response_us = row["response_us"]["last"]
                    samples.append(Sample(row["name"], index, 100 * row["quality"], response_us))
                last[row["name"]] = index
    return samples


def captured_responses(tapped: list[Tapped]) -> dict[tuple[str, int], float]:
    """Return for each answer, by publisher and cycle counter, microseconds since the request."""
    responses = {}
    asked_ns = None
    for passed in tapped:
        publisher = str(passed.header.publisher)
        if publisher == DESK:
            asked_ns = passed.at_ns
        elif asked_ns is not None:
            responses[publisher, passed.header.cycle] = (passed.at_ns - asked_ns) / 1000
    return responses


def assert_all_is_well(client: dict[str, Any], servers: list[dict[str, Any]]) -> None:
    (request,) = client["pd"]["tx"]
    for row in client["pd"]["rx"]:
        assert row["state"] == "running"
        assert row["lost"] is None
        assert request["sent"] - row["received"] <= 2  # the last is on its way
        assert row["jitter_us"]["max"] is None
    for server in servers:
        (asked,) = server["pd"]["rx"]
        assert asked["lost"] == 0
        for row in server["pd"]["tx"]:
            assert row["reason"] == {"poll": row["sent"]}
            assert 0 <= asked["received"] - row["sent"] <= 1
            assert (row["skipped"], row["var_state"], row["frame_state"]) == (0, 0, 0)


def test_two_servers_answer_on_loopback(farm: Plants) -> None:
    plant = farm.run(PLANT)
    wait_until(lambda: plant.rx("desk", "lathe-part")["received"] >= 25)
    assert_all_is_well(plant.station("desk"), [plant.station("mill"), plant.station("lathe")])
    for name in ANSWERS:
        limit_us = (SERVER_CYCLE_US + CLIENT_CYCLE_US) * slowness()
        assert plant.rx("desk", name)["response_us"]["p50"] < limit_us
    plant.command("pd", "set", "desk", "job", "7")
    wait_until(lambda: plant.values("mill")["asked.job"] == plant.values("lathe")["asked.job"] == 7)
    shown = plant.command("status", "--full")
    assert "polled" in shown
    listed = plant.command("pd", "list", "--station", "mill")
    assert "→ part 71 0 eap0 requester, polled by asked" in " ".join(listed.split())


def test_a_server_that_is_gone_leaves_the_other_and_comes_back(farm: Plants) -> None:
    client = farm.run(PLANT, "--station", "desk", "--station", "lathe")
    mill = farm.run(PLANT, "--station", "mill")
    wait_until(lambda: client.rx("desk", "mill-part")["received"] >= 5)
    mill.stop()
    wait_until(lambda: client.rx("desk", "mill-part")["state"] == "stale")
    received = client.rx("desk", "lathe-part")["received"]
    wait_until(lambda: client.rx("desk", "lathe-part")["received"] > received + 5)
    assert client.rx("desk", "lathe-part")["state"] == "running"
    farm.run(PLANT, "--station", "mill")
    wait_until(lambda: client.rx("desk", "mill-part")["state"] == "running")


def test_answers_come_back_on_the_connection_of_the_request(farm: Plants) -> None:
    text = over(
        desk="tcp://127.0.4.1", mill="tcp://127.0.4.2", lathe="tcp://127.0.4.3", to="mill/eap0"
    )
    text = text.replace(
        "    publish:\n      - {name: request",
        "      - {name: to-lathe, port: eap0, to: lathe/eap0}\n"
        "    publish:\n      - {name: second, frame: to-lathe, id: 69, variables: [job]}\n"
        "      - {name: request",
    )
    text = text.replace("lathe/part, poll: request", "lathe/part, poll: second")
    head, server, tail = text.partition("  - name: lathe")
    plant = farm.run(farm.write(head + server + tail.replace("desk/request", "desk/second")))
    wait_until(lambda: plant.rx("desk", "lathe-part")["received"] >= 25)
    wait_until(lambda: plant.rx("desk", "mill-wear")["received"] >= 25)
    for name in ANSWERS:
        row = plant.rx("desk", name)
        assert row["state"] == "running"
        limit_us = (SERVER_CYCLE_US + 2 * CLIENT_CYCLE_US) * slowness()
        assert row["response_us"]["p50"] < limit_us
    for server_name in ("mill", "lathe"):
        for row in plant.station(server_name)["pd"]["tx"]:
            assert set(row["reason"]) == {"poll"}


class Measured(NamedTuple):
    """A client and its servers on a cable with a tap.

    Attributes:
        own: Address of the client in frames.
    """

    client: Appliance
    servers: Appliance
    tap: Wiretap
    own: str


@pytest.fixture(params=["ethernet", "udp"])
def measured(farm: Plants, request: pytest.FixtureRequest) -> Iterator[Measured]:
    transport: str = request.param
    line = "ethernet://line0"
    endpoints = {
        "ethernet": over(desk=line, mill=line, lathe=line, to="multicast"),
        "udp": over(
            desk="udp://10.88.164.1", mill="udp://10.88.164.2", lathe="udp://10.88.164.3", to=GROUP
        ),
    }
    plant = farm.write(endpoints[transport])
    with cable(addresses=True) as (left, right):
        right.ip("addr", "add", "10.88.164.3/24", "dev", "line0")
        servers = farm.run(plant, "--station", "mill", "--station", "lathe", prefix=right.prefix)
        with Wiretap(left.socket(socket.AF_PACKET, socket.SOCK_RAW), "line0") as tap:
            client = farm.run(plant, "--station", "desk", prefix=left.prefix)
            wait_until(lambda: client.rx("desk", "lathe-part")["received"] >= 5)
            own = {"ethernet": left.mac(), "udp": "10.88.164.1:34980"}[transport]
            yield Measured(client, servers, tap, own)


@pytest.mark.quiet
@pytest.mark.root
def test_quality_is_the_captured_response_time(measured: Measured) -> None:
    client, servers, tap, own = measured
    samples = sample(client, SAMPLES)
    desk = client.station("desk")
    assert_all_is_well(desk, [servers.station("mill"), servers.station("lathe")])
    tapped = tap.tapped()
    requests = [passed for passed in tapped if passed.leaves]
    answers = [passed for passed in tapped if not passed.leaves]
    assert {tuple(passed.pd_ids) for passed in requests} == {(70,)}
    assert {tuple(passed.pd_ids) for passed in answers} == {(71, 72), (71,)}
    # One frame to all asks, and each answer goes to who asked.
    assert {passed.destination for passed in answers} == {own}
    assert abs(2 * len(requests) - len(answers)) <= 2

    captured = captured_responses(tapped)
    assert statistics.median(captured.values()) < SERVER_CYCLE_US + CLIENT_CYCLE_US
    assert {each.name for each in samples} == set(ANSWERS)
    assert len(samples) > SAMPLES / 2
    for each in samples:
        truth_us = captured[PUBLISHERS[each.name], each.cycle_index]
        assert abs(each.quality_us - truth_us) <= CLIENT_CYCLE_US, (each, truth_us)
        assert abs(each.response_us - truth_us) <= CLIENT_CYCLE_US, (each, truth_us)
