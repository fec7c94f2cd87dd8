"""Which slave is meant."""

from __future__ import annotations

import pytest

from devicebus.errors import BusError
from devicebus.wire.register import AlStatus
from eap.ops.bus_session import Slave, choose, no_mailbox


def slave(station, name):
    return Slave(
        station=station,
        name=name,
        vendor=1,
        product=2,
        revision=3,
        serial=4,
        alias=0,
        status=AlStatus(2),
        protocols=0,
        parent=None,
        ports=(0,),
    )


SLAVES = [slave(1001, "coupler"), slave(1002, "twin"), slave(1003, "twin")]


@pytest.mark.parametrize("name", ["1001", "0x3E9", "0X3e9", "coupler"])
def test_by_address_and_by_name(name):
    assert choose(SLAVES, name).station == 1001


@pytest.mark.parametrize("name", ["x", "1004", "0xxx", "08", ""])
def test_one_that_is_not_there(name):
    with pytest.raises(BusError, match=r"unknown slave '.*'; known slaves: 1001 \(coupler\), 1002"):
        choose(SLAVES, name)
    with pytest.raises(BusError, match="known slaves: none"):
        choose([], name)


def test_name_of_several():
    with pytest.raises(BusError, match=r"2 slaves are called 'twin': .* \(1002, 1003\)"):
        choose(SLAVES, "twin")


def test_one_without_a_mailbox():
    assert "slave 1001 (coupler) has no mailbox in INIT" in str(no_mailbox(SLAVES[0], "INIT"))
