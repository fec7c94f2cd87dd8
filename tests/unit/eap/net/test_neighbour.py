"""The neighbour table of a namespace of our own, whose entries the test writes."""

from __future__ import annotations

import socket
import struct
import time
from ipaddress import IPv4Address

import pytest

from eap.codec.arp import ETHERTYPE_ARP, REPLY, REQUEST, ArpMessage
from eap.errors import EnvironmentalError
from eap.ids import BROADCAST_MAC, MacAddr
from eap.net.bpf import MAX_ADDRESSES
from eap.net.neighbour import (
    ArpProber,
    ArpSighting,
    KernelRoute,
    NeighbourEntry,
    NeighbourState,
    NeighbourTable,
    RouteKind,
)
from eap.net.packetsocket import open_arp
from eap.pd.monitor import ProbeResult
from tests.unit.eap.net.conftest import ip, wait_for_links

pytestmark = [pytest.mark.net, pytest.mark.root]

THERE = "10.77.0.2"
MAC = MacAddr.parse("02:00:00:00:00:02")


@pytest.fixture
def table(cable):
    ip(f"addr add 10.77.0.1/24 dev {cable[0]}")
    ip("route add 10.88.0.0/16 via 10.77.0.254")
    ip("route add blackhole 10.99.0.0/16")
    table = NeighbourTable()
    yield table
    table.close()


def set_state(state, address=THERE):
    ip(f"neigh replace {address} lladdr {MAC} dev left nud {state}")


def test_own_addresses_have_no_neighbour(table):
    for address in ("10.77.0.1", "127.0.0.1", "127.5.5.5"):
        assert table.route(address).kind is RouteKind.LOCAL
        assert table.look(address) is ProbeResult.BLIND


def test_routes(table):
    index = socket.if_nametoindex("left")
    assert table.route(THERE) == KernelRoute(RouteKind.DIRECT, index, THERE)
    assert table.route(THERE, "10.77.0.1").kind is RouteKind.DIRECT
    assert table.route("10.88.3.4") == KernelRoute(RouteKind.GATEWAY, index, "10.77.0.254")
    for nowhere in ("10.99.0.1", "192.0.2.1", "10.77.0.255", "239.0.0.1"):
        assert table.route(nowhere).kind is RouteKind.NONE
        assert table.look(nowhere) is ProbeResult.BLIND


def test_neighbour_without_entry_is_pending(table):
    assert table.neighbour(THERE, socket.if_nametoindex("left")) is None
    assert table.look(THERE) is ProbeResult.PENDING


@pytest.mark.parametrize(
    ("state", "evidence"),
    [
        ("reachable", ProbeResult.SEEN),
        ("stale", ProbeResult.PENDING),
        ("failed", ProbeResult.ABSENT),
        ("permanent", ProbeResult.BLIND),
        ("noarp", ProbeResult.BLIND),
    ],
)
def test_states(table, state, evidence):
    set_state(state)
    assert table.look(THERE, "10.77.0.1") is evidence
    entry = table.neighbour(THERE, socket.if_nametoindex("left"))
    known = None if state == "failed" else MAC  # a failed one has lost its address
    assert entry == NeighbourEntry(NeighbourState[state.upper()], known)


def test_neighbour_behind_gateway_is_absent_only_with_gateway(table):
    for state, evidence in (("reachable", ProbeResult.BLIND), ("failed", ProbeResult.ABSENT)):
        set_state(state, "10.77.0.254")
        assert table.look("10.88.3.4") is evidence


def test_neighbour_at_other_interface_is_none(table):
    set_state("reachable")
    assert table.neighbour(THERE, 9999) is None


pytestmark = [pytest.mark.net, pytest.mark.root]

ADDRESS = IPv4Address("10.77.0.2")
OTHER = IPv4Address("10.77.0.3")


class Host:
    """Host at the other end of the cable."""

    def __init__(self, interface):
        self.sock = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(0x0003))
        self.sock.bind((interface, 0x0003))
        self.sock.settimeout(5)
        self.mac = MacAddr(self.sock.getsockname()[4])

    def hear(self, tag=b""):
        """Return the next frame with ARP, and the message in it."""
        head = tag + struct.pack("!H", ETHERTYPE_ARP)
        while True:
            data = self.sock.recv(2000)
            if data[12 : 12 + len(head)] == head:
                return data, ArpMessage.decode(data, 12 + len(head))

    def say(self, message, to=BROADCAST_MAC, tag=b""):
        self.sock.send(to + self.mac + tag + struct.pack("!H", ETHERTYPE_ARP) + message)

    def answer(self, asked, tag=b""):
        reply = ArpMessage(REPLY, self.mac, asked.target, asked.sender_mac, asked.sender)
        self.say(reply.encode(), asked.sender_mac, tag)


@pytest.fixture
def host(cable):
    host = Host(cable[1])
    yield host
    host.sock.close()


@pytest.fixture
def make_prober(cable):
    opened = []

    def make(**options):
        prober = ArpProber(open_arp(cable[0]), **options)
        opened.append(prober)
        prober.watch([ADDRESS])
        return prober

    yield make
    for prober in opened:
        prober.close()


def wait_heard(prober):
    limit = time.monotonic() + 5
    while not (found := prober.drain()):
        assert time.monotonic() < limit
    return found


def test_arp_probe_matches_rfc_5227(make_prober, host):
    prober = make_prober()
    assert prober.probe(ADDRESS)
    frame, asked = host.hear()
    assert frame[:12] == BROADCAST_MAC + prober.mac
    assert len(frame) == 60
    assert asked == ArpMessage.probe(prober.mac, ADDRESS)


def test_arp_reply_reports_owner(make_prober, host):
    prober = make_prober()
    prober.probe(ADDRESS)
    host.answer(host.hear()[1])
    assert wait_heard(prober) == [ArpSighting(ADDRESS, host.mac, is_claim=False)]


def test_arp_announcements_and_requests_report_sender(make_prober, host):
    prober = make_prober()
    host.say(ArpMessage(REQUEST, host.mac, ADDRESS, MacAddr(bytes(6)), ADDRESS).encode())
    assert wait_heard(prober) == [ArpSighting(ADDRESS, host.mac, is_claim=False)]
    host.say(ArpMessage(REQUEST, host.mac, ADDRESS, MacAddr(bytes(6)), OTHER).encode())
    assert wait_heard(prober) == [ArpSighting(ADDRESS, host.mac, is_claim=False)]


def test_arp_probe_of_other_host_is_claim(make_prober, host):
    prober = make_prober()
    host.say(ArpMessage.probe(host.mac, ADDRESS).encode())
    assert wait_heard(prober) == [ArpSighting(ADDRESS, host.mac, is_claim=True)]


def test_arp_ignores_other_addresses_and_malformed_messages(make_prober, host):
    prober = make_prober()
    host.say(ArpMessage(REPLY, host.mac, OTHER, prober.mac, IPv4Address(0)).encode())
    host.say(ArpMessage(REPLY, BROADCAST_MAC, ADDRESS, prober.mac, OTHER).encode())
    host.say(b"\x00\x02" + ArpMessage(REPLY, host.mac, ADDRESS, prober.mac, OTHER).encode()[2:])
    host.say(ArpMessage(REPLY, prober.mac, ADDRESS, prober.mac, OTHER).encode())
    host.say(ArpMessage(REPLY, host.mac, ADDRESS, prober.mac, OTHER).encode())
    assert wait_heard(prober) == [ArpSighting(ADDRESS, host.mac, is_claim=False)]
    assert prober.drain() == []
    assert prober.errors == {"malformed": 1}


def test_each_vlan_by_itself(make_prober, host):
    tagged, plain = make_prober(vlan_id=7, priority=5), make_prober()
    tagged.probe(ADDRESS)
    tag = struct.pack("!HH", 0x8100, 5 << 13 | 7)
    # The kernel takes the tag off before it shows the frame to a plain packet socket.
    asked = host.hear()[1]
    host.answer(asked, tag)
    assert wait_heard(tagged) == [ArpSighting(ADDRESS, host.mac, is_claim=False)]
    assert plain.drain() == []
    host.answer(asked)
    assert wait_heard(plain) == [ArpSighting(ADDRESS, host.mac, is_claim=False)]
    assert tagged.drain() == []


def test_arp_probe_of_own_address_is_not_sent(make_prober, cable):
    ip(f"addr add {ADDRESS}/24 dev {cable[1]}")
    prober = make_prober()
    assert not prober.probe(ADDRESS)
    assert not prober.probe(IPv4Address("127.0.0.9"))
    assert prober.probe(OTHER)


def test_arp_probe_on_loopback_is_not_sent(cable):
    del cable
    prober = ArpProber(open_arp("lo"))
    assert not prober.probe(ADDRESS)
    prober.close()


def test_interface_that_is_down_gives_no_answer(make_prober, cable):
    prober = make_prober()
    ip(f"link set {cable[0]} down")
    assert not prober.probe(ADDRESS)
    prober.drain()
    assert prober.errors.get("ENETDOWN")


def test_missing_interface_is_named(cable):
    del cable
    with pytest.raises(EnvironmentalError, match="no interface 'nowhere'"):
        open_arp("nowhere")


@pytest.mark.host_root
def test_no_ethernet_is_refused(cable):
    del cable
    ip("tuntap add dev tun0 mode tun")
    ip("link set tun0 up")
    with pytest.raises(EnvironmentalError, match="tun0 is not an Ethernet interface"):
        open_arp("tun0")


def test_as_many_addresses_as_the_kernel_takes(make_prober):
    prober = make_prober()
    addresses = [IPv4Address(0x0A000000 + n) for n in range(MAX_ADDRESSES + 1)]
    prober.watch(addresses[:300])
    with pytest.raises(EnvironmentalError, match="1001 addresses to monitor"):
        prober.watch(addresses)


def test_arp_prober_finds_an_interface_made_again(make_prober, cable):
    near, far = cable
    prober = make_prober()
    ip(f"link del {near}")
    assert not prober.probe(ADDRESS)
    ip(f"link add {near} address 02:00:00:00:00:11 type veth peer name {far}")
    for name in cable:
        ip(f"link set {name} up")
    wait_for_links(*cable)
    limit = time.monotonic() + 5
    while str(prober.mac) != "02:00:00:00:00:11":
        assert time.monotonic() < limit
        prober.drain()
    host = Host(far)
    try:
        assert prober.probe(ADDRESS)
        frame, asked = host.hear()
        assert (frame[6:12], asked.sender_mac) == (prober.mac, prober.mac)
        host.answer(asked)
        assert wait_heard(prober) == [ArpSighting(ADDRESS, host.mac, is_claim=False)]
    finally:
        host.sock.close()
