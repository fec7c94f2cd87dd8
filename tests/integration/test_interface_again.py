"""A cable whose interfaces are deleted and made again: all that ran on them runs again."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest

from tests.support.appliance import Appliance, Plants, run_eapctl, wait_until
from tests.support.machine import slowness
from tests.support.namespaces import Namespace, cable, lay_cable

pytestmark = [pytest.mark.net, pytest.mark.root]

STATION = """
  - name: {name}
    net_id: 10.88.164.{number}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "ethernet://line0", net_id: 10.88.164.{number}.2.1}}
      - {{name: eap1, kind: eap, interface: "udp://10.88.164.{number}", join: [239.88.164.1],
          broadcast: true, net_id: 10.88.164.{number}.2.2}}
    routes: [{{to: {peer}, via: {peer}/eap0, port: eap0}}]
    variables: {{ticks: UDINT}}
    sources: {{ticks: {{kind: counter}}}}
    frames:
      - {{name: multicast, port: eap0, to: multicast}}
      - {{name: unicast, port: eap0, to: {peer}/eap0, monitor_interval_ms: 200,
          monitor_ip: 10.88.164.{other}}}
      - {{name: group, port: eap1, to: 239.88.164.1}}
      - {{name: everyone, port: eap1, to: broadcast}}
    publish:
      - {{name: multicast, frame: multicast, id: 1, variables: [ticks]}}
      - {{name: unicast, frame: unicast, id: 2, variables: [ticks]}}
      - {{name: group, frame: group, id: 3, variables: [ticks]}}
      - {{name: everyone, frame: everyone, id: 4, variables: [ticks]}}
    subscribe:
      - {{name: by-multicast, port: eap0, from: {peer}/multicast, timeout_ms: 200}}
      - {{name: by-unicast, port: eap0, from: {peer}/unicast, timeout_ms: 200}}
      - {{name: by-group, port: eap1, from: {peer}/group, timeout_ms: 200}}
      - {{name: by-everyone, port: eap1, from: {peer}/everyone, timeout_ms: 200}}
"""
PLANT = "plant: again\ndefaults: {cycle_us: 10000}\nstations:" + "".join(
    STATION.format(name=name, peer=peer, number=number, other=3 - number)
    for name, peer, number in (("left", "right", 1), ("right", "left", 2))
)
SUBSCRIPTIONS = ("by-multicast", "by-unicast", "by-group", "by-everyone")


@pytest.fixture(scope="module")
def ends() -> Iterator[tuple[Namespace, Namespace]]:
    with cable(addresses=True) as both:
        yield both


@pytest.fixture(scope="module")
def pair(module_farm: Plants, ends: tuple[Namespace, Namespace]) -> tuple[Appliance, Appliance]:
    path = module_farm.write(PLANT)
    left, right = (
        module_farm.start(path, "--station", name, prefix=end.prefix)
        for name, end in zip(("left", "right"), ends, strict=True)
    )
    assert left.wait_ready() == ["left"]
    assert right.wait_ready() == ["right"]
    wait_until(lambda: all_run((left, right)))
    return left, right


def all_run(pair: tuple[Appliance, Appliance]) -> bool:
    return all(
        side.rx(name, each)["state"] == "running"
        for side, name in zip(pair, ("left", "right"), strict=True)
        for each in SUBSCRIPTIONS
    )


def answers(left: Appliance) -> bool:
    """Return whether the other station's port answers AoE by EtherType."""
    done = run_eapctl(left.runtime, "state", "10.88.164.2.2.1:65535")
    return done.returncode == 0 and "OP" in done.stdout


def faults(side: Appliance) -> str:
    return " ".join(side.command("status").split())


def processes(pair: tuple[Appliance, Appliance]) -> list[int]:
    return [side.status()["processes"][name]["pid"] for side in pair for name in NAMES]


NAMES = ("engine", "services")


def test_interface_made_again_carries_everything_again(
    pair: tuple[Appliance, Appliance], ends: tuple[Namespace, Namespace]
) -> None:
    left, _right = pair
    before = processes(pair)
    addresses = [end.mac() for end in ends]
    wait_until(lambda: answers(left))
    for _ in range(2):
        ends[0].ip("link", "del", "line0")
        wait_until(lambda: left.rx("left", "by-multicast")["state"] == "stale")
        shown = faults(left)
        assert "left/eap0: interface line0 is gone: it was deleted; it is found again" in shown
        assert "left/eap1: address 10.88.164.1 is gone: no interface has it now" in shown
        assert [port["link"] for port in left.station("left")["ports"]] == ["down", "down"]

        lay_cable(ends, addresses=True)
        assert not {end.mac() for end in ends} & set(addresses)
        busy = slowness()
        took_s = wait_until(lambda: all_run(pair))
        assert took_s < 2.0 * max(busy, slowness())
        wait_until(lambda: answers(left))
        assert [port["link"] for port in left.station("left")["ports"]] == ["up", "up"]
        assert "is gone" not in faults(left)
        (source,) = {left.rx("left", each)["source"] for each in SUBSCRIPTIONS[:2]}
        assert source == ends[1].mac()
    assert processes(pair) == before


def test_engine_and_services_restarted_while_it_is_away(
    pair: tuple[Appliance, Appliance], ends: tuple[Namespace, Namespace]
) -> None:
    left, _ = pair
    wait_until(lambda: all_run(pair))
    ends[0].ip("link", "del", "line0")
    for name in NAMES:
        pid = left.pid(name)
        os.kill(pid, signal.SIGKILL)
        left.wait_for_another(name, pid)
    lay_cable(ends, addresses=True)
    wait_until(lambda: all_run(pair))
    wait_until(lambda: answers(left))
