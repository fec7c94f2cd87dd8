"""What a part of a slave's mailbox refuses unless it overrides it."""

from __future__ import annotations

import asyncio

import pytest

from eap.aoe.ads_notifications import Client
from eap.aoe.ads_operation import AdsRefusedError
from eap.aoe.way import Way
from eap.appliance.bus_request import SlaveReport
from eap.appliance.services.bus_ads.slave_space import Asked, SlaveSpace
from eap.codec.ads import AdsError
from eap.ids import NetId
from tests.support.fakeengine import PORT

SLAVE = SlaveReport(
    station=1001, name="s", vendor=1, product=2, revision=3, serial=4, alias=0,
    state=2, target=2, to_slave=128, to_master=256,
)  # fmt: skip
ASKED = Asked(SLAVE, Client(Way("", ""), NetId(bytes(6)), 1))


def test_everything_is_refused():
    space = SlaveSpace(None, PORT)
    for work in (
        space.read(ASKED, 1, 2, 3),
        space.write(ASKED, 1, 2, b"x"),
        space.read_write(ASKED, 1, 2, 3, b"x"),
        space.read_write(ASKED, 1, 2, 3, b""),
    ):
        with pytest.raises(AdsRefusedError) as refused:
            asyncio.run(work)
        assert refused.value.result == AdsError.SERVICE


def test_sizes_are_those_of_the_report():
    assert (ASKED.sizes.to_slave, ASKED.sizes.to_master) == (128, 256)
