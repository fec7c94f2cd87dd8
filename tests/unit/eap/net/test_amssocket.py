from __future__ import annotations

import socket

import pytest

from eap.errors import EnvironmentalError
from eap.net import amssocket
from eap.net.amssocket import open_ams_broadcast, open_ams_listener, open_ams_socket
from tests.support.addresses import own_address

pytestmark = pytest.mark.net


def test_both_are_opened_and_a_second_of_each_is_told_what_to_do():
    address = own_address(0)
    with open_ams_listener(address) as listener, open_ams_socket(address) as datagrams:
        assert listener.getsockname() == (address, 48898)
        assert datagrams.getsockname() == (address, 48899)
        for open_again, port in ((open_ams_listener, 48898), (open_ams_socket, 48899)):
            with pytest.raises(EnvironmentalError) as refused:
                open_again(address)
            text = str(refused.value)
            assert f"{address}:{port} is in use by process" in text
            assert text.endswith(
                "; without AMS at this address the station runs too: `ams: false` at its EAP "
                "ports there"
            )


def test_listener_is_free_again_at_once_with_connections_in_time_wait():
    address = own_address(0)
    for _ in range(2):
        with (
            open_ams_listener(address) as listener,
            socket.create_connection((address, 48898)),
        ):
            listener.accept()[0].close()


def test_foreign_address_is_refused():
    for opener in (open_ams_listener, open_ams_socket):
        with pytest.raises(EnvironmentalError, match=r"192\.0\.2\.1"):
            opener("192.0.2.1")


@pytest.mark.parametrize(
    ("group", "bound"), [("", "127.255.255.255"), ("255.255.255.255", "255.255.255.255")]
)
def test_what_goes_to_a_whole_network_arrives_at_each_station(group, bound):
    sockets = [open_ams_broadcast(address, group) for address in ("127.9.6.1", "127.9.6.2")]
    try:
        assert [sock.getsockname() for sock in sockets] == [(bound, 48899)] * 2
        if not group:
            with open_ams_socket(own_address(0)) as asking:
                asking.sendto(b"who?", (bound, 48899))
                for sock in sockets:
                    sock.settimeout(5)
                    assert sock.recvfrom(10) == (b"who?", asking.getsockname())
    finally:
        for sock in sockets:
            sock.close()


def test_a_network_without_broadcasts_is_a_warning(monkeypatch, caplog):
    monkeypatch.setattr(amssocket, "broadcast_of", lambda address: "")
    assert open_ams_broadcast("127.9.6.1", "") is None
    assert "tools do not find 127.9.6.1 by broadcast (UDP 48899): the network has no" in caplog.text


def test_a_broadcast_address_that_is_taken_is_a_warning(caplog):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.255.255.255", 48899))
        assert open_ams_broadcast("127.9.6.1", "") is None
    assert "Address already in use" in caplog.text
