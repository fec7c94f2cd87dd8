"""Addresses of the gateway: master, slave, remote slave, group."""

from __future__ import annotations

from eap.gateway.requests import (
    AddressMap,
    GroupAddress,
    MasterAddress,
    RemoteAddress,
    SlaveAddress,
)
from eap.ids import NetId

THERE = (1001, 1002, 0x8005)


def test_addresses_of_the_standard() -> None:
    addresses = AddressMap()
    assert addresses.resolve(0, THERE) == MasterAddress()
    assert addresses.resolve(1001, THERE) == SlaveAddress(1001)
    assert addresses.resolve(7, THERE) == SlaveAddress(7), "who is not there is asked all the same"
    assert addresses.resolve(0xFFFF, THERE) == GroupAddress(THERE), "and not slave 0x7fff"


def test_bit_15_marks_a_slave_unless_that_is_its_address() -> None:
    addresses = AddressMap()
    assert addresses.resolve(0x8000 | 1001, THERE) == SlaveAddress(1001)
    assert addresses.resolve(0x8005, THERE) == SlaveAddress(0x8005)
    assert addresses.resolve(0x8000, THERE) == SlaveAddress(0)


def test_virtual_addresses_go_first() -> None:
    remote = RemoteAddress(NetId.parse("1.2.3.4.5.6"), 1001)
    virtual = {
        1001: SlaveAddress(1002),
        0x9000: remote,
        40: GroupAddress((1001, 0x9000)),
        0: SlaveAddress(1),
        0xFFFF: remote,
    }
    addresses = AddressMap(virtual)
    assert addresses.resolve(1001, THERE) == SlaveAddress(1002)
    assert addresses.resolve(0x9000, THERE) == remote
    assert addresses.resolve(40, THERE) == GroupAddress((1001, 0x9000))
    assert addresses.resolve(0, THERE) == MasterAddress()
    assert addresses.resolve(0xFFFF, THERE) == GroupAddress(THERE)
