"""Two routers and a client of another make, connected by a real broker only."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager

import pytest

from eap.ams.routes import Origin, Route
from eap.ams.spec import MqttSpec, RoutingSpec
from eap.ams.transport_table import Transport
from eap.codec.ams import AmsAnswer, AmsCommand
from eap.ids import Endpoint, NetId
from eap.runtime.drop_counters import DropReason
from eap.services.transports.mqtt_transport import MqttTransport
from eap.services.transports.station_brokers import StationBrokers
from tests.support.ams import ADD_NOTIFICATION, NOTIFICATION, Ams
from tests.support.busads import until
from tests.support.eventually import eventually
from tests.support.mosquitto import broker
from tests.support.mqttclient import PahoPeer
from tests.support.routing import RecordingSender, station

pytestmark = [pytest.mark.net, pytest.mark.mosquitto]

ADDRESS = "127.0.3.42"
ONE, TWO = NetId.parse("5.1.1.1.2.1"), NetId.parse("6.1.1.1.2.1")
DEVICE = 0xFFFF
PEER = "7.7.7.7.1.1"


def spec(network: str = "hall", **more: object) -> MqttSpec:
    return MqttSpec(network=network, host=ADDRESS, **more)


class Place:
    """A station with its transports to brokers."""

    def __init__(self, net_id: NetId, *specs: MqttSpec, learns: bool = True) -> None:
        self.router = station(str(net_id), name=f"of {net_id[0]}")
        self.refused: list[DropReason] = []
        self.transports = [
            MqttTransport(each, self.router, self.refused.append, learns=learns)
            for each in specs or (spec(),)
        ]

    async def serve(self) -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(self.router.serve())
            for transport in self.transports:
                group.create_task(transport.serve())

    def knows(self, net_id: NetId) -> bool:
        return self.router.table.find(net_id) is not None

    async def read(self, target: NetId, body: bytes = b"abc", timeout_s: float = 20) -> AmsAnswer:
        return await self.router.request(target, DEVICE, AmsCommand.READ, body, timeout_s=timeout_s)


@asynccontextmanager
async def running(*places: Place):
    tasks = [asyncio.ensure_future(place.serve()) for place in places]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


@pytest.mark.parametrize("no_retain", [False, True])
def test_stations_that_know_nothing_of_each_other_meet(tmp_path, no_retain):
    async def story():
        one, two = Place(ONE, spec(no_retain=no_retain)), Place(TWO, spec(no_retain=no_retain))
        async with running(one):
            assert (await one.read(TWO)).error_code == 7
            async with running(two):
                await eventually(lambda: one.knows(TWO) and two.knows(ONE))
                (route,) = one.router.table
                assert (route.name, route.origin) == ("of 6", Origin.LEARNED)
                answers = await asyncio.gather(*[one.read(TWO, b"%d" % n) for n in range(50)])
                assert answers == [AmsAnswer(bytes(4) + b"\2" + (b"%d" % n)[::-1])
                                   for n in range(50)]  # fmt: skip
                assert (await two.read(ONE)).data == b"\0\0\0\0\2cba"
                assert not one.refused + two.refused
            await eventually(lambda: one.router.is_down(route.hop))
            assert (await one.read(TWO)).error_code == 0x1B

    with broker(tmp_path, ADDRESS):
        asyncio.run(story())


def test_service_resumes_when_the_broker_does(tmp_path):
    async def story(server):
        one, two = Place(ONE), Place(TWO)
        async with running(one, two):
            await eventually(lambda: one.knows(TWO) and two.knows(ONE))
            server.stop()
            hop = Endpoint("mqtt:hall", "6.1.1.1.1.1")
            await eventually(lambda: one.router.is_down(hop))
            assert (await one.read(TWO)).error_code == 0x1B
            server.start()

            async def is_answered() -> bool:
                return not (await one.read(TWO, timeout_s=0.3)).error_code

            await until(is_answered)

    with broker(tmp_path, ADDRESS) as server:
        asyncio.run(story(server))


def test_client_reads_and_subscribes_through_two_stations(tmp_path):
    tool = "192.168.9.9.1.1:33000"

    async def story():
        one, two = Place(ONE), Place(TWO)
        sender = RecordingSender()
        one.router.add_transport(Transport("ams-tcp", is_stream=True, is_hub=True), sender)
        asked = []
        async with running(two), running(one):
            await eventually(lambda: one.knows(TWO))
            (service,) = two.router._services._services[TWO]
            service._reply = lambda request: (
                asked.append(request)
                or AmsAnswer((0).to_bytes(4, "little") + (77).to_bytes(4, "little"))
            )
            request = Ams(f"{TWO}:65535", tool, command=ADD_NOTIFICATION, body=bytes(40))
            one.router.receive(request.octets(), "ams-tcp", "10.0.0.9:1#1")
            await eventually(lambda: sender.sent)
            assert sender.sent[0][1] == request.answer(bytes(4) + b"M\0\0\0")
            (there,) = asked
            assert str(there.header.source) == "5.1.1.1.1.1"
            stamps = bytes.fromhex("01000000 0000000000000000 01000000 4d000000 02000000 6869")
            body = len(stamps).to_bytes(4, "little") + stamps
            news = Ams(f"{there.header.source}:{there.header.source_port}", request.target,
                       command=NOTIFICATION, body=body)  # fmt: skip
            two.router.send_notification(there.endpoint, news.octets())
            await eventually(lambda: len(sender.sent) == 2)
            assert sender.sent[1] == ("10.0.0.9:1#1", news._replace(target=tool))
            one_is_gone = [Endpoint("mqtt:hall", "5.1.1.1.1.1")]
            one.transports[0]._link.send(one.transports[0]._network.will())
            await eventually(lambda: service.gone == one_is_gone)

    with broker(tmp_path, ADDRESS):
        asyncio.run(story())


@pytest.mark.parametrize("is_prefixed", [False, True], ids=["bare", "prefixed"])
def test_client_of_another_make_sends_and_answers_requests(tmp_path, is_prefixed):
    async def story():
        place = Place(ONE)
        async with running(place):
            with PahoPeer(ADDRESS, "hall", PEER, is_prefixed=is_prefixed) as peer:
                await asyncio.to_thread(peer.wait_for_router, "5.1.1.1.1.1", "of 5")
                asked = Ams(f"{ONE}:65535", f"{PEER}:800", body=b"abc", invoke_id=9)
                answer = await asyncio.to_thread(peer.ask, "5.1.1.1.1.1", asked)
                assert answer == asked.answer(b"\0\0\0\0\2cba")
                await eventually(lambda: place.knows(NetId.parse(PEER)))
                assert (await place.read(NetId.parse(PEER))).data == b"peer was asked"
                assert peer.forms == {is_prefixed}
            hop = Endpoint("mqtt:hall", PEER)
            await eventually(lambda: place.router.is_down(hop))

    with broker(tmp_path, ADDRESS):
        asyncio.run(story())


def test_station_forwards_between_two_brokers(tmp_path):
    async def story():
        one = Place(ONE, spec("near"))
        middle = Place(NetId.parse("8.1.1.1.2.1"), spec("near"), spec("far", port=1884))
        two = Place(TWO, spec("far", port=1884))
        for place, target in ((one, TWO), (two, ONE)):
            hop = Endpoint(place.transports[0].name, "8.1.1.1.1.1")
            route = Route(target, "through", hop, is_probed=False)
            place.router.add_route(route)
        async with running(one, middle, two):
            await eventually(lambda: middle.knows(ONE) and middle.knows(TWO))
            await eventually(lambda: not one.router.is_down(Endpoint("mqtt:near", "8.1.1.1.1.1")))
            assert (await one.read(TWO)).data == b"\0\0\0\0\2cba"
            assert (await two.read(ONE)).data == b"\0\0\0\0\2cba"

    with broker(tmp_path / "1", ADDRESS), broker(tmp_path / "2", ADDRESS, port=1884):
        asyncio.run(story())


def test_disabled_learning_learns_nothing(tmp_path):
    async def story():
        one, two = Place(ONE, learns=False), Place(TWO)
        async with running(one, two):
            await eventually(lambda: two.knows(ONE))
            assert (await two.read(ONE)).data == b"\0\0\0\0\2cba"
            assert not one.knows(TWO)

    with broker(tmp_path, ADDRESS):
        asyncio.run(story())


def test_dropped_messages_are_counted(tmp_path, caplog):
    async def story():
        place = Place(ONE)
        asked = Ams(f"{ONE}:65535", f"{PEER}:800", body=bytes(300_000))
        async with running(place):
            with PahoPeer(ADDRESS, "hall", PEER) as peer:
                await asyncio.to_thread(peer.wait_for_router, "5.1.1.1.1.1", "of 5")
                peer.publish("5.1.1.1.1.1", "ams", b"no packet")
                peer.publish("6.6.6.6.6.6", "info", b"no info")
                peer.publish("5.1.1.1.1.1", "ams/res", asked.octets())
                answer = await asyncio.to_thread(peer.ask, "5.1.1.1.1.1", asked)
                assert answer == asked.answer(b"", 0xE)
        assert sorted(place.refused) == ["ams_length", "mqtt_broken", "mqtt_broken", "mqtt_topic"]

    with broker(tmp_path, ADDRESS):
        asyncio.run(story())
    assert "of 5: mqtt:hall: broken packet: hall/5.1.1.1.1.1/ams: " in caplog.text


@pytest.mark.parametrize("qos", [1, 2])
def test_packets_are_sent_with_the_configured_qos(tmp_path, qos):
    async def story():
        one, two = Place(ONE, spec(qos=qos)), Place(TWO, spec(qos=qos))
        async with running(one, two):
            await eventually(lambda: one.knows(TWO) and two.knows(ONE))
            answers = await asyncio.gather(*[one.read(TWO, b"%d" % n) for n in range(100)])
            assert {each.error_code for each in answers} == {0}

    with broker(tmp_path, ADDRESS) as server:
        asyncio.run(story())
        assert (
            f"Received PUBLISH from eap-5.1.1.1.1.1-hall (d0, q{qos}, r0" in server.log.read_text()
        )


def test_station_gets_the_mqtt_transports_of_its_plant_file():
    async def story():
        router = station("5.1.1.1.2.1")
        dropped = []
        brokers = StationBrokers(router)
        brokers.open(RoutingSpec(mqtt=(spec("x"), spec("y"))), dropped.append)
        transports = brokers._transports
        transports["x"]._overrun()
        assert dropped == [DropReason.MQTT_FULL]
        assert [each.name for each in transports.values()] == ["mqtt:x", "mqtt:y"]
        why = transports["x"].send("6.1.1.1.1.1", (bytes(32),))
        assert why.startswith("no connection to MQTT broker")
        assert router.is_down(Endpoint("mqtt:x", "6.1.1.1.1.1"))

    asyncio.run(story())


def test_mqtt_transport_learns_in_the_configured_networks(tmp_path):
    async def story():
        one, two = station("5.1.1.1.2.1"), Place(TWO, spec("y"), spec("x"))
        told = RoutingSpec(mqtt=(spec("x"), spec("y")), learn=("mqtt:y",))
        brokers = StationBrokers(one)
        brokers.open(told, lambda reason: None)
        task = asyncio.ensure_future(brokers.serve())
        async with running(two):
            await eventually(lambda: len([*one.table]) == 1)
            await eventually(lambda: len([*two.router.table]) == 2)
        task.cancel()
        await asyncio.wait([task])
        assert [each.hop.transport for each in one.table] == ["mqtt:y"]

    with broker(tmp_path, ADDRESS):
        asyncio.run(story())
