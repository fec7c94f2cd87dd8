"""Presence of subscribers, and frames to a NetID: on the loopback and between namespaces."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from typing import Any

import pytest

from tests.support.appliance import Appliance, Plants, wait_until
from tests.support.namespaces import Namespace, cable

pytestmark = pytest.mark.net

STATION = """
  - name: {name}
    net_id: 127.9.8.{number}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "{interface}", net_id: 127.9.8.{number}.2.1}}
    variables: {{{name}-ticks: UDINT}}
    sources: {{{name}-ticks: {{kind: counter}}}}
    frames:
      - {{name: to-{peer}, port: eap0, {frame}}}
    publish:
      - {{name: {name}, frame: to-{peer}, id: {number}, variables: [{name}-ticks]}}
    subscribe:
      - {{name: {peer}, port: eap0, from: {peer}/{peer}, timeout_ms: 200}}
"""
SOON_S = 40.0


def pair(left: str, right: str, interfaces: tuple[str, str]) -> str:
    """Two stations that send to each other; *left* and *right* say where, and what more."""
    stations = (("left", 1, "right", left), ("right", 2, "left", right))
    return "plant: pair\nstations:" + "".join(
        STATION.format(name=name, number=number, peer=peer, frame=frame, interface=interface)
        for (name, number, peer, frame), interface in zip(stations, interfaces, strict=True)
    )


def frame(appliance: Appliance, station: str = "left") -> dict[str, Any]:
    (row,) = appliance.station(station)["frames"]
    return dict(row)


def wait_for(appliance: Appliance, subscriber: str) -> None:
    wait_until(lambda: frame(appliance)["subscriber"] == subscriber, SOON_S)


def found_until(appliance: Appliance, condition: Callable[[], object]) -> set[str]:
    """Return what the subscriber of left is said to be until *condition* holds."""
    found = set()

    def look() -> object:
        found.add(frame(appliance)["subscriber"])
        return condition()

    wait_until(look)
    return found


def received(right: Appliance) -> int:
    return int(right.rx("right", "left")["received"])


def hurry(end: Namespace) -> None:
    """Have the kernel check its neighbours at once."""
    settings = {
        "base_reachable_time_ms": 200,
        "delay_first_probe_time": 0,
        "retrans_time_ms": 100,
        "ucast_solicit": 1,
    }
    lines = (f"echo {n} > /proc/sys/net/ipv4/neigh/line0/{key}" for key, n in settings.items())
    subprocess.run([*end.prefix, "sh", "-c", "\n".join(lines)], check=True)


def test_on_the_loopback_a_subscriber_is_missing_or_unknown_but_never_present(
    farm: Plants,
) -> None:
    monitored = "to: 127.9.8.{}, monitor_interval_ms: 200"
    text = pair(monitored.format(2), monitored.format(1), ("udp://127.9.8.1", "udp://127.9.8.2"))
    path = farm.write(text)
    left = farm.run(path, "--station", "left")
    wait_for(left, "missing")
    row = left.tx("left", "left")
    assert (row["frame_state"], row["subscriber"], row["skipped"]) == (4, "missing", 0)
    assert row["sent"] > 0
    shown = left.command("status", "--full")
    assert "left/to-right" in shown
    assert "missing" in shown

    right = farm.run(path, "--station", "right")
    wait_for(left, "unknown")
    assert found_until(left, lambda: received(right) > 100) == {"unknown"}
    assert left.tx("left", "left")["frame_state"] == 0
    rx = right.rx("right", "left")
    assert (rx["lost"], rx["duplicated"]) == (0, 0)
    assert frame(right, "right")["subscriber"] == "unknown"

    right.close()
    wait_for(left, "missing")
    assert left.tx("left", "left")["skipped"] == 0


@pytest.mark.root
def test_on_udp_the_kernel_knows_its_neighbours(farm: Plants) -> None:
    text = pair(
        "to: 127.9.8.2.2.1, monitor_interval_ms: 200",
        "to: left/eap0",
        ("udp://10.88.164.1", "udp://10.88.164.2"),
    )
    path = farm.write(text)
    with cable(addresses=True) as (here, there):
        hurry(here)
        left = farm.run(path, "--station", "left", prefix=here.prefix)
        wait_for(left, "missing")  # the host is there, and says that nobody listens
        right = farm.run(path, "--station", "right", prefix=there.prefix)
        wait_for(left, "present")
        right.close()
        wait_for(left, "missing")
        farm.run(path, "--station", "right", prefix=there.prefix)
        wait_for(left, "present")
        there.ip("addr", "del", "10.88.164.2/24", "dev", "line0")
        wait_for(left, "missing")
        there.ip("addr", "add", "10.88.164.2/24", "dev", "line0")
        wait_for(left, "present")
        assert left.tx("left", "left")["skipped"] == 0


@pytest.mark.root
def test_arp_tells_whether_a_station_on_ethernet_is_there(farm: Plants) -> None:
    text = pair(
        "to: right/eap0, monitor_interval_ms: 200, monitor_ip: 10.88.164.2",
        "to: multicast",
        ("ethernet://line0", "ethernet://line0"),
    )
    path = farm.write(text)
    with cable(addresses=True) as (here, there):
        left = farm.run(path, "--station", "left", prefix=here.prefix)
        wait_until(lambda: frame(left)["skipped"] > 10)
        waiting = frame(left)
        assert (waiting["address"], waiting["sent"], waiting["frame_state"]) == (None, 0, 1)
        assert waiting["subscriber"] == "unknown"
        assert "MAC address of 127.9.8.2.2.1 unknown" in left.command("status")

        right = farm.run(path, "--station", "right", prefix=there.prefix)
        wait_for(left, "present")
        assert frame(left)["address"] == there.mac()
        assert frame(left)["frame_state"] == 0
        wait_until(lambda: right.rx("right", "left")["received"] > 10)

        there.unplug()
        wait_for(left, "missing")
        assert left.tx("left", "left")["frame_state"] & 4
        there.plug()
        there.ip("addr", "replace", "10.88.164.2/24", "dev", "line0")
        wait_for(left, "present")
        document = json.loads(left.command("status", "--json"))
        assert document["processes"]["services"]["restarts"] == 0


@pytest.mark.root
def test_an_answer_from_another_interface_is_no_subscriber(farm: Plants) -> None:
    text = pair(
        'to: "02:00:00:00:00:09", monitor_interval_ms: 200, monitor_ip: 10.88.164.2',
        "to: multicast",
        ("ethernet://line0", "ethernet://line0"),
    )
    with cable(addresses=True) as (here, there):
        left = farm.run(farm.write(text), "--station", "left", prefix=here.prefix)
        wait_for(left, "missing")
        _, _, told = left.stop()
        assert f"10.88.164.2 is answered by {there.mac()} instead" in told


@pytest.mark.root
def test_killed_engine_sends_on_to_the_learned_address(farm: Plants) -> None:
    text = pair("to: right/eap0", "to: multicast", ("ethernet://line0", "ethernet://line0"))
    path = farm.write(text)
    with cable() as (here, there):
        left = farm.run(path, "--station", "left", prefix=here.prefix)
        right = farm.run(path, "--station", "right", prefix=there.prefix)
        wait_until(lambda: frame(left)["sent"] > 10)
        right.close()
        skipped = frame(left)["skipped"]
        subprocess.run([*here.prefix, "kill", "-9", str(left.pid("engine"))], check=True)
        wait_until(lambda: left.station("left")["restarts"] == 1)
        before = frame(left)["sent"]
        wait_until(lambda: frame(left)["sent"] > before)
        assert frame(left)["address"] == there.mac()
        assert frame(left)["skipped"] == skipped
