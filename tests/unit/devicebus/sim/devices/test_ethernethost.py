"""ARP and ping of a simulated device; scapy makes the questions and reads the answers."""

from __future__ import annotations

from ipaddress import IPv4Address

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scapy.layers.inet import ICMP, IP, UDP
from scapy.layers.l2 import ARP, Ether

from devicebus.sim.devices.ethernethost import EthernetHost
from eap.codec.eoe import IpSettings
from eap.ids import MacAddr

MAC, IP_ADDRESS = "02:01:05:30:03:e9", "192.168.0.7"
PEER_MAC, PEER_IP = "02:00:00:00:00:09", "192.168.0.9"
SETTINGS = IpSettings(mac=MacAddr.parse(MAC), ip=IPv4Address(IP_ADDRESS))
TO_ALL = "ff:ff:ff:ff:ff:ff"


@pytest.fixture
def host():
    return EthernetHost(lambda: SETTINGS)


def question(ip=IP_ADDRESS, mac=MAC, size=32, **more):
    packet = IP(src=PEER_IP, dst=ip, **more) / ICMP(type=8, id=5, seq=6) / bytes(size)
    return bytes(Ether(src=PEER_MAC, dst=mac) / packet)


def test_who_has(host):
    asked = Ether(src=PEER_MAC, dst=TO_ALL) / ARP(
        op=1, hwsrc=PEER_MAC, psrc=PEER_IP, pdst=IP_ADDRESS
    )
    (answer,) = map(Ether, host.receive_frame(bytes(asked) + bytes(18)))
    assert (answer.src, answer.dst, answer[ARP].op) == (MAC, PEER_MAC, 2)
    assert (answer[ARP].hwsrc, answer[ARP].psrc) == (MAC, IP_ADDRESS)
    assert (answer[ARP].hwdst, answer[ARP].pdst) == (PEER_MAC, PEER_IP)


@pytest.mark.parametrize("size", [0, 33, 1400])
def test_ping(host, size):
    (octets,) = host.receive_frame(question(size=size))
    answer = Ether(octets)
    assert (answer.src, answer.dst) == (MAC, PEER_MAC)
    assert (answer[IP].src, answer[IP].dst) == (IP_ADDRESS, PEER_IP)
    assert (answer[ICMP].type, answer[ICMP].id, answer[ICMP].seq) == (0, 5, 6)
    sums = answer[IP].chksum, answer[ICMP].chksum
    del answer[IP].chksum, answer[ICMP].chksum
    again = Ether(bytes(answer))
    assert (again[IP].chksum, again[ICMP].chksum) == sums


@pytest.mark.parametrize(
    "frame",
    [
        question(ip="192.168.0.8"),
        question(mac=PEER_MAC),
        question(flags="MF"),
        question(frag=3),
        question()[:40],
        question()[:10],
        bytes(Ether(src=PEER_MAC, dst=MAC) / IP(src=PEER_IP, dst=IP_ADDRESS) / UDP() / b"12345678"),
        bytes(Ether(dst=MAC) / IP(src=PEER_IP, dst=IP_ADDRESS) / ICMP(type=0)),
        bytes(Ether(dst=TO_ALL) / ARP(op=1, pdst="192.168.0.8")),
        bytes(Ether(dst=TO_ALL) / ARP(op=2, pdst=IP_ADDRESS)),
        bytes(Ether(dst=TO_ALL) / ARP(op=1, pdst=IP_ADDRESS))[:30],
        bytes(Ether(dst=MAC, type=0x88A4)),
    ],
)
def test_what_is_not_for_it_is_not_answered(host, frame):
    assert host.receive_frame(frame) == []


def test_host_without_an_address_is_silent():
    assert EthernetHost(IpSettings).receive_frame(question()) == []


@given(st.binary(max_size=80), st.integers(0, 60))
def test_any_frame(noise, at):
    frame = question()
    EthernetHost(lambda: SETTINGS).receive_frame(noise)
    EthernetHost(lambda: SETTINGS).receive_frame(frame[:at] + noise + frame[at + len(noise) :])
