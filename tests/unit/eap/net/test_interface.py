"""Interfaces as the kernel reports them."""

from __future__ import annotations

import time

import pytest

from eap.errors import EnvironmentalError
from eap.net.interface import (
    broadcast_of,
    check_interface,
    interface_of,
    link_is_up,
    own_addresses,
)
from tests.unit.eap.net.conftest import ip

pytestmark = pytest.mark.net


def test_loopback_addresses_belong_to_lo():
    assert interface_of("127.9.8.7") == "lo"


def test_loopback_has_a_broadcast_address():
    assert broadcast_of("127.9.8.7") == "127.255.255.255"


@pytest.mark.root
def test_each_address_has_the_broadcast_address_of_its_network(cable):
    ip("addr add 10.1.2.3/24 broadcast + dev left")
    ip("addr add 10.1.2.4/30 broadcast + dev left label left:1")
    ip("addr add 10.7.0.1/31 dev left")
    found = [broadcast_of(address) for address in ("10.1.2.3", "10.1.2.4", "10.7.0.1")]
    assert found == ["10.1.2.255", "10.1.2.7", ""]


def test_loopback_is_among_the_addresses():
    assert ("lo", "127.0.0.1") in own_addresses()


def test_foreign_address_belongs_to_none():
    with pytest.raises(EnvironmentalError, match=r"203\.0\.113\.9 is not an address of this mach"):
        interface_of("203.0.113.9")


@pytest.mark.root
def test_first_and_further_addresses_are_found(cable):
    ip("addr add 10.1.2.3/24 dev left")
    ip("addr add 10.1.2.4/24 dev left label left:1")
    ip("addr add 10.9.0.1/24 dev right")
    found = [interface_of(address) for address in ("10.1.2.3", "10.1.2.4", "10.9.0.1")]
    assert found == ["left", "left", "right"]


@pytest.mark.root
def test_link_follows_the_cable(cable):
    assert link_is_up("left")
    ip("link set right down")
    limit = time.monotonic() + 5
    while link_is_up("left"):
        assert time.monotonic() < limit
    check_interface("left")  # switched on, which is enough to open it


def test_missing_interface_has_no_link():
    assert not link_is_up("eth77")
    with pytest.raises(EnvironmentalError, match="no interface 'eth77', expected one of"):
        check_interface("eth77")


def test_name_longer_than_the_kernel_takes_is_missing_too():
    assert not link_is_up("x" * 40)
