"""Links of interfaces that go down and come up."""

from __future__ import annotations

import asyncio

from eap.ams.transport_table import Transport
from eap.ids import Endpoint
from eap.services.network import LinkWatch
from tests.support.eventually import eventually, settle
from tests.support.routing import RecordingSender, station, while_serving
from tests.support.virtualtime import run_virtual

HOP = Endpoint("link", "hop")


def watch_of(router, is_up):
    router.add_transport(Transport("link"), RecordingSender())
    watch = LinkWatch(is_up)
    watch.add("eth7", router, "link")
    return watch


def test_link_watch_takes_hops_down_and_up_with_the_link():
    there = station()
    up = {"eth7": True}
    watch = watch_of(there, up.__getitem__)
    seen = []
    for is_up in (True, False, False, True, True):
        up["eth7"] = is_up
        watch.poll()
        seen.append(there.is_down(HOP))
    assert seen == [False, True, True, False, False]


def test_link_watch_serve_polls_repeatedly():
    there = station()
    polls = []

    def is_up(name):
        polls.append(name)
        return False

    watch = watch_of(there, is_up)

    async def script():
        serving = asyncio.ensure_future(watch.serve())
        await eventually(lambda: len(polls) >= 2)
        serving.cancel()

    run_virtual(while_serving(script(), there))


def test_link_watch_begins_to_poll_with_the_first_interface():
    polls = []

    def is_up(name):
        polls.append(name)
        return True

    async def script():
        watch = LinkWatch(is_up)
        serving = asyncio.ensure_future(watch.serve())
        await settle()
        assert not polls
        router = station()
        router.add_transport(Transport("link"), RecordingSender())
        watch.add("eth7", router, "link")
        await eventually(lambda: len(polls) >= 2)
        serving.cancel()

    run_virtual(script())


def test_link_watch_forgets_removed_transports():
    there = station()
    up = {"eth7": False}
    watch = watch_of(there, up.__getitem__)
    watch.poll()
    assert there.is_down(HOP)
    watch.remove(there, "link")
    up.clear()
    watch.poll()
    up["eth7"] = True
    watch.add("eth7", there, "link")
    there.hop_up("link", None)
    watch.poll()
    assert not there.is_down(HOP)


def test_link_watch_takes_a_transport_down_that_is_added_without_a_link():
    there, up = station(), {"eth7": False}
    watch = watch_of(there, up.__getitem__)
    watch.poll()
    there.add_transport(Transport("second"), RecordingSender())
    watch.add("eth7", there, "second")
    assert there.is_down(Endpoint("second", "hop"))
