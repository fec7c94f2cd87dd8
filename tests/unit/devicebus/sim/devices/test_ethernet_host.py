"""Host of a simulated slave; scapy is the referee of its packets."""

from __future__ import annotations

from ipaddress import IPv4Address

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scapy.layers.inet import ICMP, IP, TCP
from scapy.layers.l2 import ARP, Ether

from devicebus.sim.devices import ethernet_host
from devicebus.sim.devices.ethernet_host import EthernetHost, mac_of
from eap.codec.eoe import IpSettings
from eap.ids import MacAddr

OWN, PEER, ROUTER = "10.0.0.2", "10.0.0.1", "10.0.0.9"
PEER_MAC = "02:00:00:00:00:01"
MAC = str(MacAddr(mac_of("drive")))
GET = b"GET / HTTP/1.1\r\nHost: drive\r\n\r\n"


class Wire:
    """The host, as scapy talks to it."""

    def __init__(self, settings: IpSettings | None = None) -> None:
        self.settings = settings or IpSettings(ip=IPv4Address(OWN))
        self.host = EthernetHost("drive", lambda: self.settings)

    def ask(self, packet, target: str = MAC) -> list:
        """Return the answers to a packet, with their check sums recomputed and compared."""
        found = []
        for octets in self.host.receive_frame(bytes(Ether(src=PEER_MAC, dst=target) / packet)):
            answer = Ether(octets)
            again = answer.copy()
            for layer in (IP, TCP, ICMP):
                if layer in again:
                    del again[layer].chksum
            assert bytes(again) == octets
            found.append(answer)
        return found

    def tcp(self, flags: str, seq: int, ack: int = 0, data: bytes = b"", **how: int) -> list:
        how = {"sport": 4000, "dport": 80} | how
        segment = TCP(flags=flags, seq=seq, ack=ack, **how)
        return self.ask(IP(src=PEER, dst=OWN) / segment / data)


@pytest.fixture
def wire() -> Wire:
    return Wire()


def fetch(wire: Wire, request: bytes, sport: int = 4000, start: int = 0xFFFF_FFF0) -> bytes:
    """Return the response to a request over a connection that is opened and closed."""
    (opened,) = wire.tcp("S", start, sport=sport)
    assert (str(opened[TCP].flags), opened[TCP].ack) == ("SA", (start + 1) & 0xFFFF_FFFF)
    ack, at = opened[TCP].seq + 1, start + 1
    assert wire.tcp("A", at & 0xFFFF_FFFF, ack, sport=sport) == []
    *parts, end = wire.tcp("PA", at & 0xFFFF_FFFF, ack, request, sport=sport)
    at = (at + len(request)) & 0xFFFF_FFFF
    data = b"".join(bytes(each[TCP].payload) for each in parts)
    assert [each[TCP].seq for each in parts][:1] == [ack]
    assert end[TCP].flags.F
    assert end[TCP].ack == at
    last = (ack + len(data) + 1) & 0xFFFF_FFFF
    (done,) = wire.tcp("FA", at, last, sport=sport)
    assert (done[TCP].ack, str(done[TCP].flags)) == ((at + 1) & 0xFFFF_FFFF, "A")
    return data


def test_host_serves_a_web_page(wire):
    wire.settings = IpSettings(ip=IPv4Address(OWN), name="<axis>")
    head, _, body = fetch(wire, GET).partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 200 OK\r\n")
    assert f"Content-Length: {len(body)}".encode() in head
    assert b"<h1>drive</h1>" in body
    assert OWN.encode() in body
    assert b"&lt;axis&gt;" in body


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (b"GET /favicon.ico HTTP/1.1\r\n\r\n", b"404 Not Found"),
        (b"POST / HTTP/1.1\r\n\r\n", b"501 Not Implemented"),
        (b"nonsense\r\n\r\n", b"501 Not Implemented"),
    ],
)
def test_host_answers_other_requests_with_their_status(wire, request_, status):
    assert fetch(wire, request_).startswith(b"HTTP/1.1 " + status)


def test_head_request_gets_no_body(wire):
    assert fetch(wire, b"HEAD / HTTP/1.1\r\n\r\n").endswith(b"\r\n\r\n")


def test_repeated_request_is_answered_again(wire):
    ack = wire.tcp("S", 100)[0][TCP].seq + 1
    first = wire.tcp("PA", 101, ack, GET)
    assert len(first) >= 2
    assert [bytes(each) for each in wire.tcp("PA", 101, ack, GET)] == [
        bytes(each) for each in first
    ]


def test_request_may_come_in_pieces(wire):
    ack = wire.tcp("S", 100)[0][TCP].seq + 1
    (waiting,) = wire.tcp("PA", 101, ack, GET[:10])
    assert waiting[TCP].ack == 111
    (out_of_order,) = wire.tcp("PA", 150, ack, b"x")
    assert out_of_order[TCP].ack == 111
    assert b"200 OK" in bytes(wire.tcp("PA", 111, ack, GET[10:])[0])


def test_unknown_segments_are_reset_and_resets_are_not_answered(wire):
    (refused,) = wire.tcp("A", 5, 7)
    assert str(refused[TCP].flags) == "RA"
    (closed,) = wire.tcp("S", 5, dport=23)
    assert str(closed[TCP].flags) == "RA"
    assert wire.tcp("R", 5) == []


def test_connections_and_requests_are_bounded(wire, monkeypatch):
    monkeypatch.setattr(ethernet_host, "MAX_CONNECTIONS", 2)
    acks = [wire.tcp("S", 1, sport=port)[0][TCP].seq + 1 for port in (1, 2, 3)]
    assert str(wire.tcp("A", 2, acks[0], sport=1)[0][TCP].flags) == "RA"
    long = b"x" * 1400
    for count in range(2):
        wire.tcp("PA", 2 + 1400 * count, acks[1], long, sport=2)
    assert str(wire.tcp("PA", 2802, acks[1], long, sport=2)[0][TCP].flags) == "RA"
    assert wire.tcp("FA", 2, acks[2], sport=3)[-1][TCP].flags.F  # a client that says nothing


def test_host_answers_arp_and_ping_to_its_own_address(wire):
    query = ARP(hwsrc=PEER_MAC, psrc=PEER, pdst=OWN)
    (answer,) = wire.ask(query, "ff:ff:ff:ff:ff:ff")
    assert (answer[ARP].op, answer[ARP].hwsrc, answer[ARP].psrc) == (2, MAC, OWN)
    (pong,) = wire.ask(IP(src=PEER, dst=OWN) / ICMP(type=8, id=7) / b"data")
    assert (pong[ICMP].type, pong[ICMP].id, bytes(pong[ICMP].payload)) == (0, 7, b"data")
    for other in (
        ARP(hwsrc=PEER_MAC, psrc=PEER, pdst="10.0.0.3"),
        ARP(op=2, hwsrc=PEER_MAC, psrc=PEER, pdst=OWN),
        IP(src=PEER, dst="10.0.0.3") / ICMP(),
        IP(src=PEER, dst=OWN, flags="MF") / ICMP(),
        IP(src=PEER, dst=OWN, proto=17) / bytes(20),
        b"",
    ):
        assert wire.ask(other) == []
    assert wire.ask(query, "02:00:00:00:00:77") == []


@pytest.mark.parametrize("ip", [None, IPv4Address(0)])
def test_host_without_an_address_is_silent(ip):
    wire = Wire(IpSettings(ip=ip))
    assert wire.ask(ARP(hwsrc=PEER_MAC, psrc=PEER, pdst=OWN), "ff:ff:ff:ff:ff:ff") == []
    assert wire.host.announce() == []


def test_host_announces_its_address_and_looks_for_its_gateway():
    settings = IpSettings(ip=IPv4Address(OWN), gateway=IPv4Address(ROUTER))
    own, gateway = (Ether(each)[ARP] for each in Wire(settings).host.announce())
    assert (own.psrc, own.pdst, own.hwsrc) == (OWN, OWN, MAC)
    assert (gateway.psrc, gateway.pdst) == (OWN, ROUTER)
    assert len(Wire(IpSettings(ip=IPv4Address(OWN))).host.announce()) == 1


@pytest.mark.parametrize("cut", range(0, 60, 7))
def test_cut_packets_are_ignored(wire, cut):
    whole = bytes(Ether(src=PEER_MAC, dst=MAC) / IP(src=PEER, dst=OWN) / TCP(flags="S") / b"data")
    assert wire.host.receive_frame(whole[:cut]) == []


@pytest.mark.parametrize("size", [0, 33, 1400])
def test_ping_of_any_size_is_answered(wire, size):
    (pong,) = wire.ask(IP(src=PEER, dst=OWN) / ICMP(type=8) / bytes(size))
    assert bytes(pong[ICMP].payload) == bytes(size)


@given(st.binary(max_size=80), st.integers(0, 60), st.sampled_from([ICMP(), TCP(flags="PA")]))
def test_any_bytes_leave_the_host_alive(noise, at, layer):
    wire = Wire()
    frame = bytes(Ether(src=PEER_MAC, dst=MAC) / IP(src=PEER, dst=OWN) / layer / bytes(20))
    wire.host.receive_frame(noise)
    wire.host.receive_frame(frame[:at] + noise + frame[at + len(noise) :])
    assert wire.tcp("S", 1)
