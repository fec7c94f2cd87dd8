"""Links that go down and come up."""

from __future__ import annotations

import asyncio

from eap.ads.endpoint import Endpoint
from eap.ams.transport_table import Transport
from eap.services.sockets import LinkWatch
from tests.support.eventually import eventually
from tests.support.routing import KeepingCarrier, station, while_serving

HOP = Endpoint("door", "hop")


def test_hops_behind_a_link_are_down_and_up_with_it():
    there = station()
    there.add_transport(Transport("door"), KeepingCarrier())
    up = {"eth7": True}
    watch = LinkWatch({"eth7": [(there, "door")]}, up.__getitem__)
    seen = []
    for is_up in (True, False, False, True, True):
        up["eth7"] = is_up
        watch.look()
        seen.append(there.is_down(HOP))
    assert seen == [False, True, True, False, False]


def test_it_looks_again_and_again():
    there = station()
    looks = []

    def is_up(name):
        looks.append(name)
        return False

    there.add_transport(Transport("door"), KeepingCarrier())
    watch = LinkWatch({"eth7": [(there, "door")]}, is_up)

    async def script():
        looking = asyncio.ensure_future(watch.serve())
        await eventually(lambda: len(looks) >= 2)
        looking.cancel()

    asyncio.run(while_serving(script(), there))


def test_nothing_to_look_after_is_no_work():
    asyncio.run(asyncio.wait_for(LinkWatch({}).serve(), 1))
