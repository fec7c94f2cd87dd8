"""The kernel's sorting of frame types, by the kernel itself."""

from __future__ import annotations

import socket

import pytest

from eap.net import bpf

pytestmark = pytest.mark.net

ENGINE_TYPES = {n for n in range(16) if n not in (2, 3, 5)}


DATAGRAMS = [*(bytes([n, n << 4 | 0x7]) for n in range(16)), b"\xee"]


def exchange(role_filter, datagrams=DATAGRAMS):
    """Return the first octets of those of *datagrams* that get past *role_filter*."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind(("127.0.3.11", 0))
        receiver.setblocking(False)
        bpf.attach(receiver, role_filter)
        for datagram in datagrams:
            sender.sendto(datagram, receiver.getsockname())
        got = set()
        while True:
            try:
                got.add(receiver.recv(100)[0])
            except BlockingIOError:
                return got


def test_engine_gets_its_types_unknown_ones_and_short_datagrams():
    assert exchange(bpf.udp_filter(bpf.SocketRole.ENGINE)) == ENGINE_TYPES | {0xEE}


def test_udp_pair_sorts_acyclic_types_to_services():
    assert exchange(bpf.udp_filter(bpf.SocketRole.SERVICES)) == {2, 3, 5}


def test_kernel_refusal_is_an_os_error():
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with sock, pytest.raises(OSError, match="Invalid argument"):
        bpf.attach(sock, [(0xFFFF, 0, 0, 0)])


def ethernet_like(frame_type, ethertype=b"\x88\xa4"):
    """A datagram whose UDP header and data look like the start of an Ethernet frame."""
    return bytes([frame_type]) + bytes(3) + ethertype + bytes([0, frame_type << 4])


@pytest.mark.parametrize(
    ("role", "types"), [(bpf.SocketRole.ENGINE, ENGINE_TYPES), (bpf.SocketRole.SERVICES, {2, 3, 5})]
)
def test_packet_filter_keeps_its_types_of_our_ethertype(role, types):
    datagrams = [ethernet_like(n) for n in range(16)]
    assert exchange(bpf.packet_filter(role), datagrams) == types
    foreign = [ethernet_like(n, b"\x08\x00") for n in range(16)]
    assert exchange(bpf.packet_filter(role), [*foreign, b"short"]) == set()


def test_bus_gets_type_1_alone():
    datagrams = [ethernet_like(n) for n in range(16)]
    assert exchange(bpf.type1_filter(), datagrams) == {1}
    foreign = [ethernet_like(n, b"\x08\x00") for n in range(16)]
    assert exchange(bpf.type1_filter(), [*foreign, b"short"]) == set()
