"""Whom addresses mean."""

from __future__ import annotations

from eap.gateway.address import AddressMap, Group, Master, RemoteSlave, Slave
from eap.ids import NetId

THERE = (1001, 1002, 0x8005)


def test_addresses_of_the_standard() -> None:
    addresses = AddressMap()
    assert addresses.resolve(0, THERE) == Master()
    assert addresses.resolve(1001, THERE) == Slave(1001)
    assert addresses.resolve(7, THERE) == Slave(7), "who is not there is asked all the same"
    assert addresses.resolve(0xFFFF, THERE) == Group(THERE), "and not slave 0x7fff"


def test_bit_15_marks_a_slave_unless_that_is_its_address() -> None:
    addresses = AddressMap()
    assert addresses.resolve(0x8000 | 1001, THERE) == Slave(1001)
    assert addresses.resolve(0x8005, THERE) == Slave(0x8005)
    assert addresses.resolve(0x8000, THERE) == Slave(0)


def test_virtual_addresses_go_first() -> None:
    remote = RemoteSlave(NetId.parse("1.2.3.4.5.6"), 1001)
    virtual = {
        1001: Slave(1002),
        0x9000: remote,
        40: Group((1001, 0x9000)),
        0: Slave(1),
        0xFFFF: remote,
    }
    addresses = AddressMap(virtual)
    assert addresses.resolve(1001, THERE) == Slave(1002)
    assert addresses.resolve(0x9000, THERE) == remote
    assert addresses.resolve(40, THERE) == Group((1001, 0x9000))
    assert addresses.resolve(0, THERE) == Master()
    assert addresses.resolve(0xFFFF, THERE) == Group(THERE)
