"""Every way from one station to another: who hears whom over which kind of port."""

from __future__ import annotations

import itertools
import socket

import pytest

from eap.codec.ethercat import EAP_PORT, ETHERTYPE
from eap.codec.pd import PdFrameHeader, PdHeader, encode_frame
from eap.ids import NetId
from tests.support.appliance import Appliance, Plants, troubles, wait_until
from tests.support.namespaces import cable

pytestmark = pytest.mark.net

MULTICAST = bytes.fromhex("010105040000")
STRANGER = bytes.fromhex("020000000009")


def station(name: str, number: int, interface: str, *, port: str = "", more: str = "") -> str:
    """A station with one port; *port* and *more* go into the port and behind it."""
    return f"""\
  - name: {name}
    net_id: 10.9.7.{number}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "{interface}", net_id: 10.9.7.{number}.2.1{port}}}
{more}"""


def sender(to: str) -> str:
    return f"""\
    variables: {{ticks: UDINT}}
    sources:
      ticks: {{kind: counter}}
    frames:
      - {{name: out, port: eap0, to: "{to}"}}
    publish:
      - {{name: state, frame: out, id: 1, variables: [ticks]}}
"""


def receiver(*froms: str) -> str:
    rows = [
        f"      - {{name: {source}, port: eap0, from: {source}/state, timeout_ms: 5000}}\n"
        for source in froms
    ]
    return "    subscribe:\n" + "".join(rows)


def plant(*stations: str, cycle_us: int = 10_000) -> str:
    head = f"plant: paths\ndefaults: {{cycle_us: {cycle_us}}}\nstations:\n"
    return head + "".join(stations)


def wait_for_frames(appliance: Appliance, listener: str, source: str, frames: int) -> None:
    wait_until(lambda: appliance.rx(listener, source)["received"] >= frames)


def assert_hears(appliance: Appliance, listener: str, *froms: str, frames: int = 30) -> None:
    """Frames come, none is lost, and they carry what the sender counts."""
    for source in froms:
        wait_for_frames(appliance, listener, source, frames)
        rx = appliance.rx(listener, source)
        assert (*troubles(rx), rx["state"]) == (0, 0, 0, "running")
        ticks = appliance.values(listener)[f"{source}.ticks"]
        # The counter goes on in cycles that a busy machine leaves out.
        assert 0 <= (ticks - rx["cycle_index"]) % 65536 < 20_000


def test_multicast_over_udp_reaches_three_stations_of_one_appliance(farm: Plants) -> None:
    group = "239.9.7.1"
    names = ("one", "two", "three")
    appliance = farm.run(
        farm.write(
            plant(
                station("source", 1, "udp://127.9.7.1", more=sender(group)),
                *(
                    station(name, number, f"udp://127.9.7.{number}", more=receiver("source"))
                    for number, name in enumerate(names, 2)
                ),
                station("deaf", 9, "udp://127.9.7.9"),
            )
        )
    )
    for name in names:
        assert_hears(appliance, name, "source")
        assert appliance.station(name)["discarded"] == {}
    assert appliance.station("deaf")["discarded"] == {}


@pytest.mark.root
def test_broadcast_over_udp_reaches_this_host_and_the_other(farm: Plants) -> None:
    text = plant(
        station("source", 1, "udp://10.88.164.1", more=sender("broadcast")),
        station("far", 2, "udp://10.88.164.2", more=receiver("source")),
        station("near", 3, "udp://10.88.164.3", more=receiver("source")),
    )
    with cable(addresses=True) as (here, there):
        here.ip("addr", "add", "10.88.164.3/24", "dev", "line0")
        path = farm.write(text)
        far = farm.run(path, "--station", "far", prefix=there.prefix)
        near = farm.run(path, "--station", "source", "--station", "near", prefix=here.prefix)
        assert_hears(far, "far", "source")
        assert_hears(near, "near", "source")


@pytest.mark.root
@pytest.mark.parametrize("destination", ["multicast", "broadcast"])
def test_stations_of_one_appliance_on_one_interface_hear_each_other(
    farm: Plants, destination: str
) -> None:
    link = "ethernet://line0"
    text = plant(
        station("one", 1, link, more=sender(destination) + receiver("two", "far")),
        station("two", 2, link, more=sender(destination) + receiver("one", "far")),
        station("far", 3, link, more=sender(destination) + receiver("one", "two")),
    )
    with cable() as (here, there):
        path = farm.write(text)
        far = farm.run(path, "--station", "far", prefix=there.prefix)
        near = farm.run(path, "--station", "one", "--station", "two", prefix=here.prefix)
        assert_hears(near, "one", "two", "far")
        assert_hears(near, "two", "one", "far")
        assert_hears(far, "far", "one", "two")


@pytest.mark.root
def test_unicast_over_ethernet_goes_to_its_address_only(farm: Plants) -> None:
    with cable() as (here, there):
        link = "ethernet://line0"
        path = farm.write(
            plant(
                station("source", 1, link, more=sender(there.mac())),
                station("far", 2, link, more=receiver("source")),
                station("near", 3, link),
            )
        )
        far = farm.run(path, "--station", "far", prefix=there.prefix)
        near = farm.run(path, "--station", "source", "--station", "near", prefix=here.prefix)
        assert_hears(far, "far", "source")
        # Stale is what came before the engine was ready, such as questions to all routers.
        assert near.station("near")["discarded"].keys() <= {"stale"}


@pytest.mark.root
def test_a_named_vlan_is_sent_tagged_and_all_others_are_counted(farm: Plants) -> None:
    link, vlan = "ethernet://line0", ", vlan: {id: 7, priority: 5}"
    text = plant(
        station("source", 1, link, port=vlan, more=sender("multicast")),
        station("tagged", 2, link, port=vlan, more=receiver("source")),
    )
    frame = encode_frame(
        PdFrameHeader(NetId.parse("9.9.9.9.9.9"), 1, 1), [(PdHeader(99, 0, 2), b"\1\2")]
    )
    with cable() as (here, there):
        path = farm.write(text)
        far = farm.run(path, "--station", "tagged", prefix=there.prefix)
        with there.socket(socket.AF_PACKET, socket.SOCK_RAW, 0) as wire:
            wire.setsockopt(263, 8, 1)  # SOL_PACKET, PACKET_AUXDATA
            wire.bind(("line0", 3))
            farm.run(path, "--station", "source", prefix=here.prefix)
            assert_hears(far, "tagged", "source")
            while True:
                octets, ((_, _, auxiliary),), _, address = wire.recvmsg(2048, 64)
                if address[2] != socket.PACKET_OUTGOING and octets[15] >> 4 == 4:
                    break
            assert int.from_bytes(auxiliary[16:18], "little") == 5 << 13 | 7
        before = far.station("tagged")["discarded"]
        with here.socket(socket.AF_PACKET, socket.SOCK_RAW) as wire:
            wire.bind(("line0", 0))
            kind = ETHERTYPE.to_bytes(2, "big")
            for tag in (b"", b"\x81\x00\x00\x08", b"\x81\x00\x00\x00", b"\x81\x00\xa0\x07"):
                wire.send((MULTICAST + STRANGER + tag + kind + frame).ljust(60, b"\0"))
        wait_until(lambda: "unknown_id" in far.station("tagged")["discarded"])
        wait_until(lambda: far.station("tagged")["discarded"].get("other_vlan", 0) == 3)
        after = far.station("tagged")["discarded"]
        assert after == before | {"unknown_id": 1, "other_vlan": 3}


@pytest.mark.root
def test_an_untagged_port_takes_priority_tags_and_counts_vlans(farm: Plants) -> None:
    frame = encode_frame(
        PdFrameHeader(NetId.parse("9.9.9.9.9.9"), 1, 1), [(PdHeader(99, 0, 2), b"\1\2")]
    )
    with cable() as (here, there):
        path = farm.write(plant(station("plain", 1, "ethernet://line0")))
        plain = farm.run(path, prefix=there.prefix)
        with here.socket(socket.AF_PACKET, socket.SOCK_RAW) as wire:
            wire.bind(("line0", 0))
            for tag in (b"", b"\x81\x00\xe0\x00", b"\x81\x00\xe0\x07"):
                content = tag + ETHERTYPE.to_bytes(2, "big") + frame
                wire.send((MULTICAST + STRANGER + content).ljust(60, b"\0"))
        expected = {"unknown_id": 2, "other_vlan": 1}
        wait_until(lambda: plain.station("plain")["discarded"] == expected)


def test_two_ports_of_one_station(farm: Plants) -> None:
    """PDs that arrive at one port leave by the other; the same PD id at both is no conflict."""
    gateway = """\
  - name: gateway
    net_id: 10.9.7.5.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.9.7.5", net_id: 10.9.7.5.2.1}
      - {name: eap1, kind: eap, interface: "udp://127.9.7.6", net_id: 10.9.7.5.3.1}
    frames:
      - {name: up, port: eap0, to: left/eap0}
      - {name: down, port: eap1, to: right/eap0}
    publish:
      - {name: state, frame: up, id: 1, variables: [r]}
      - {name: other, frame: down, id: 1, variables: [l]}
    subscribe:
      - {name: left, port: eap0, from: left/state, variables: {l: UDINT}}
      - {name: right, port: eap1, from: right/state, variables: {r: UDINT}}
"""
    right = receiver("gateway").replace("gateway/state", "gateway/other")
    right = right.replace("timeout_ms", "variables: {gateway.ticks: UDINT}, timeout_ms")
    left = receiver("gateway").replace(
        "timeout_ms", "variables: {gateway.ticks: UDINT}, timeout_ms"
    )
    appliance = farm.run(
        farm.write(
            plant(
                station("left", 1, "udp://127.9.7.1", more=sender("127.9.7.5") + left),
                station("right", 2, "udp://127.9.7.2", more=sender("127.9.7.6") + right),
                gateway,
            )
        )
    )
    for side in ("left", "right"):
        wait_for_frames(appliance, side, "gateway", 30)
        assert troubles(appliance.rx(side, "gateway")) == (0, 0, 0)
        assert appliance.values(side)["gateway.ticks"] > 20
    ports = {rx["name"]: rx["port"] for rx in appliance.station("gateway")["pd"]["rx"]}
    assert ports == {"left": "eap0", "right": "eap1"}
    assert appliance.station("gateway")["discarded"] == {}


class Stream:
    """A peer of a publisher over TCP, which reads or does not."""

    def __init__(self, address: str) -> None:
        self.listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self.listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self.listener.settimeout(10)
        self.listener.bind((address, EAP_PORT))
        self.listener.listen()


@pytest.mark.parametrize("first", ["source", "sink"])
def test_tcp_connects_in_either_order_and_again(farm: Plants, first: str) -> None:
    path = farm.write(
        plant(
            station("source", 1, "udp://127.9.7.1", more=sender("tcp://127.9.7.2")),
            station("sink", 2, "udp://127.9.7.2", port=", tcp: true", more=receiver("source")),
        )
    )
    one = farm.run(path, "--station", first)
    if first == "source":
        wait_until(lambda: one.tx("source", "state")["skipped"] > 50)
    other = farm.run(path, "--station", "sink" if first == "source" else "source")
    source, sink = (one, other) if first == "source" else (other, one)
    assert_hears(sink, "sink", "source")
    skipped = source.tx("source", "state")["skipped"]

    assert sink.stop()[0] == 0
    wait_until(lambda: source.tx("source", "state")["skipped"] > skipped + 20)
    again = farm.run(path, "--station", "sink")
    assert_hears(again, "sink", "source")
    assert source.status()["processes"]["engine"]["restarts"] == 0


def test_slow_tcp_peer_loses_whole_frames_and_delays_no_other(farm: Plants) -> None:
    both = sender("tcp://127.9.7.2").replace(
        "    publish:\n",
        "      - {name: fast, port: eap0, to: 127.9.7.3}\n"
        "    publish:\n"
        "      - {name: bulk, frame: out, id: 2, variables: [ticks, block]}\n",
    )
    both = both.replace("frame: out, id: 1", "frame: fast, id: 1")
    both = both.replace("ticks: UDINT", "ticks: UDINT, block: BLOCK(1400)")
    path = farm.write(
        plant(
            station("source", 1, "udp://127.9.7.1", more=both),
            station("other", 3, "udp://127.9.7.3", more=receiver("source")),
            cycle_us=2000,
        )
    )
    peer = Stream("127.9.7.2")
    with peer.listener:
        appliance = farm.run(path)
        connection, _ = peer.listener.accept()
        with connection:
            wait_until(lambda: appliance.tx("source", "bulk")["skipped"] > 100)
            assert_hears(appliance, "other", "source", frames=300)
            rx = appliance.rx("other", "source")
            assert rx["timeouts"] == 0
            connection.settimeout(5)
            data = b""
            while len(data) < 300_000:
                data += connection.recv(65536)
    size = 14 + 8 + 4 + 1400
    assert data[:2] == (size - 2 | 4 << 12).to_bytes(2, "little")
    cycles = []
    for start in range(0, len(data) - size + 1, size):
        frame = data[start : start + size]
        assert frame[:10] == data[:10]  # header, publisher and count: no frame was ever cut
        carried, counted = (int.from_bytes(frame[at : at + 2], "little") for at in (22, 10))
        assert (carried - counted) % 65536 < 20_000  # the counter that the data carries
        cycles.append(int.from_bytes(frame[10:12], "little"))
    steps = [later - earlier for earlier, later in itertools.pairwise(cycles)]
    assert min(steps) == 1
    assert max(steps) > 100  # the frames that were lost while nobody read
