"""Opening pairs of UDP sockets: sorting, groups, and what goes wrong."""

from __future__ import annotations

import socket

import pytest

from eap.errors import EnvironmentalError
from eap.net.udpsocket import open_udp_group_pair, open_udp_pair, open_udp_receiver

pytestmark = pytest.mark.net

PORT = 34980


def close(*pairs):
    for pair in pairs:
        for sock in pair:
            sock.close()


def received(sock):
    sock.setblocking(False)
    got = set()
    while True:
        try:
            got.add(sock.recv(100)[0])
        except BlockingIOError:
            return got


def send_all_types(sock, destination):
    for frame_type in range(16):
        sock.sendto(bytes([frame_type, frame_type << 4]), (destination, PORT))
    sock.sendto(b"\xee", (destination, PORT))


ENGINE = {n for n in range(16) if n not in (2, 3, 5)} | {0xEE}


def test_kernel_sorts_unicast_by_type():
    pair, other = open_udp_pair("127.0.3.14"), open_udp_pair("127.0.3.15")
    try:
        send_all_types(other[0], "127.0.3.14")
        assert received(pair[0]) == ENGINE
        assert received(pair[1]) == {2, 3, 5}
    finally:
        close(pair, other)


@pytest.mark.parametrize("group", ["239.88.164.1", "255.255.255.255"])
def test_each_process_gets_its_types_of_a_group(group):
    sender = open_udp_pair("127.0.3.14")
    pairs = [open_udp_group_pair(group, address) for address in ("127.0.3.14", "127.0.3.15")]
    try:
        send_all_types(sender[0], group)
        for engine, services in pairs:
            assert received(engine) == ENGINE
            assert received(services) == {2, 3, 5}
        assert received(sender[0]) == set()
    finally:
        close(sender, *pairs)


def test_a_receiver_gets_all_types_and_shares_with_nobody():
    receiver, other = open_udp_receiver("127.0.3.14", PORT), open_udp_pair("127.0.3.15")
    try:
        send_all_types(other[0], "127.0.3.14")
        assert received(receiver) == {*range(16), 0xEE}
        with pytest.raises(EnvironmentalError, match=r"127\.0\.3\.14"):
            open_udp_receiver("127.0.3.14", PORT)
    finally:
        close((receiver,), other)


def test_second_appliance_is_refused_though_the_port_could_be_shared():
    pair = open_udp_pair("127.0.3.16")
    try:
        with pytest.raises(EnvironmentalError, match=r"^UDP 127.0.3.16:34980 is in use by process"):
            open_udp_pair("127.0.3.16")
    finally:
        close(pair)


def test_client_that_got_the_port_by_chance_is_named_with_the_cure():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.bind(("127.0.3.17", PORT))
        client.connect(("127.0.3.18", 53))
        with pytest.raises(EnvironmentalError) as caught:
            open_udp_pair("127.0.3.17")
    message = str(caught.value)
    assert "a client connected to 127.0.3.18:53" in message
    assert "ip_local_reserved_ports=34980" in message
    assert "\n" not in message


@pytest.mark.parametrize(
    "attempt",
    [
        lambda: open_udp_pair("203.0.113.9"),
        lambda: open_udp_group_pair("239.88.164.1", "203.0.113.9"),
        lambda: open_udp_group_pair("255.255.255.255", "203.0.113.9"),
    ],
)
def test_foreign_address_is_named(attempt):
    with pytest.raises(EnvironmentalError, match=r"203\.0\.113\.9 is not an address of this mach"):
        attempt()
