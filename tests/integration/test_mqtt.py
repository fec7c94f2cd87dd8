"""Stations that reach each other through a real broker and nothing else, as separate appliances."""

from __future__ import annotations

import itertools
import os
import signal
import socket
import struct
import time
from collections.abc import Iterator

import pytest

from eap.codec.adsnotification import AddNotification, TransMode, decode_notification
from tests.support.ams import ADD_NOTIFICATION, Ams
from tests.support.appliance import Appliance, plants, wait_until
from tests.support.machine import slowness
from tests.support.mosquitto import Broker, broker
from tests.support.mqttclient import PahoPeer
from tests.support.mqtthalls import (
    BROKER,
    NORTH,
    SOUTH,
    VENDOR_OF_DRIVE,
    read,
    until_read,
    write_plant,
)
from tests.support.namespaces import row

pyads = pytest.importorskip("pyads", reason="needs pyads: pip install pyads")

pytestmark = [pytest.mark.net, pytest.mark.mosquitto]

STATUS = 0x60410000
NO_ROUTE, UNREACHABLE, DENIED = 7, 0x1B, 0x723


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    with broker(tmp_path_factory.mktemp("broker"), BROKER) as made:
        yield made


@pytest.fixture(scope="module")
def halls(server: Broker) -> Iterator[tuple[Appliance, Appliance]]:
    """Two appliances that know nothing of each other."""
    with plants() as farm:
        north = farm.run(write_plant(farm.folder, "north", NORTH))
        south = farm.run(write_plant(farm.folder, "south", SOUTH))
        until_read(NORTH, NORTH)
        until_read(SOUTH, SOUTH)
        yield north, south


def test_slaves_are_reached_both_ways_and_only_read(halls):
    until_read(SOUTH, by=NORTH)
    until_read(NORTH, by=SOUTH)
    assert read(SOUTH, NORTH, STATUS) == read(SOUTH, SOUTH, STATUS) >= 0
    with pyads.Connection(f"{SOUTH}.3.1", 1001, NORTH) as drive:
        assert drive.read_device_info()[0] == "drive"
        with pytest.raises(pyads.ADSError) as refused:
            drive.write(0xF302, 0x60650000, 2000, pyads.PLCTYPE_UDINT)
        assert refused.value.err_code == DENIED


def test_broker_is_restarted_in_mid_run_and_service_resumes(halls, server):
    until_read(SOUTH, by=NORTH)
    server.stop()
    wait_until(lambda: read(SOUTH, NORTH) == -UNREACHABLE)
    began = time.monotonic()
    assert read(SOUTH, NORTH) == -UNREACHABLE
    assert time.monotonic() - began < 1 * slowness()
    assert read(NORTH, NORTH) == VENDOR_OF_DRIVE
    server.start()
    until_read(SOUTH, by=NORTH)
    until_read(NORTH, by=SOUTH)


def test_subscription_outlives_its_broker_and_the_client_may_have_any_net_id(halls, server):
    until_read(SOUTH, by=NORTH)
    north, _ = halls
    body = AddNotification(0xF302, 0x10000000, 4, TransMode.SERVER_CYCLE, 0, 500_000).encode()
    own = f"{NORTH}.1.1:33000"
    add = Ams(f"{SOUTH}.2.1:65535", own, ADD_NOTIFICATION, invoke_id=1, body=body).octets()
    with socket.create_connection((NORTH, 48898)) as client, client.makefile("rb") as stream:

        def next_packet() -> bytes:
            _, length = struct.unpack("<HI", stream.read(6))
            return stream.read(length)

        def next_value() -> int:
            ((sample,),) = (stamp.samples for stamp in decode_notification(next_packet()[32:]))
            assert sample.handle == handle
            return int.from_bytes(sample.data, "little")

        def interrupted() -> int:
            (router,) = north.request("routes_list")
            return sum(row["count"] for row in router["interruptions"])

        client.settimeout(60)
        client.sendall(struct.pack("<HI", 0, len(add)) + add)
        result, handle = struct.unpack("<II", next_packet()[32:])
        assert result == 0
        device_type = next_value()
        server.stop()
        wait_until(lambda: interrupted() == 1)
        server.start()
        wait_until(lambda: interrupted() == 0)
        for _ in range(100):  # more than waited in the socket
            assert next_value() == device_type


def test_station_whose_services_die_is_down_at_once_and_comes_back(halls):
    until_read(SOUTH, by=NORTH)
    _, south = halls
    supervisor, south_services = south.process.pid, south.pid("services")
    os.kill(supervisor, signal.SIGSTOP)  # so that nobody starts them again yet
    try:
        os.kill(south_services, signal.SIGKILL)
        wait_until(lambda: read(SOUTH, NORTH) == -UNREACHABLE)
    finally:
        os.kill(supervisor, signal.SIGCONT)
    until_read(SOUTH, by=NORTH)
    assert south.pid("services") != south_services


def test_client_of_another_make_is_served_and_hostile_ones_are_not(halls):
    north, _ = halls
    octets = read(SOUTH, SOUTH).to_bytes(4, "little")
    before = north.pid("services")
    with PahoPeer(BROKER, "works", "9.9.9.9.1.1", is_prefixed=True) as peer:
        peer.wait_for_router(f"{SOUTH}.1.1", "south")
        body = bytes.fromhex("02f30000 01001810 04000000")
        asked = Ams(f"{SOUTH}.3.1:1001", "9.9.9.9.1.1:800", body=body)
        assert peer.ask(f"{SOUTH}.1.1", asked).body == bytes(4) + b"\4\0\0\0" + octets
        for payload in (b"", b"\0" * 31, b"\xff" * 70_000, asked.octets()[:40], bytes(900_000)):
            for rest in ("ams", "ams/res", "info"):
                peer.publish(f"{NORTH}.1.1", rest, payload)
        peer.publish("7.7.7.7.1.1", "info", b"<!DOCTYPE a [<!ENTITY b 'c'>]><info>&b;</info>")
        assert peer.ask(f"{SOUTH}.1.1", asked).body[:8] == bytes(4) + b"\4\0\0\0"
    until_read(SOUTH, by=NORTH)
    assert north.pid("services") == before


def test_flood_leaves_memory_and_engine_alone(halls):
    """Messages of all kinds as fast as paho sends, to one hall; tools at it are answered."""
    north, _ = halls
    wait_until(lambda: read(NORTH, NORTH) == VENDOR_OF_DRIVE)
    before = north.status()["processes"]
    packet = Ams(f"{NORTH}.3.1:1001", "9.9.9.9.1.1:800", body=bytes(12)).octets()
    told = b"<info><online name='x'>true</online></info>"
    with PahoPeer(BROKER, "works", "9.9.9.9.1.1") as peer:
        end = time.monotonic() + 2
        for number in itertools.count():
            asked = packet[:28] + number.to_bytes(4, "little") + packet[32:]
            peer.publish(f"{NORTH}.1.1", "ams", asked)
            peer.publish(f"{NORTH}.1.1", "ams/res", packet)
            peer.publish(f"{NORTH}.1.1", "ams", bytes(20_000))
            peer.publish(f"9.9.{number >> 8 & 0xFF}.{number & 0xFF}.1.1", "info", told)
            if number % 100 == 0:
                assert read(NORTH, NORTH) == VENDOR_OF_DRIVE
                if number >= 200 and time.monotonic() > end:
                    break
    after = north.status()["processes"]
    assert after["services"]["rss"] - before["services"]["rss"] < 48 << 20
    assert [after[each]["restarts"] for each in ("engine", "services")] == [
        before[each]["restarts"] for each in ("engine", "services")
    ]
    wait_until(lambda: north.station("north")["discarded"]["mqtt_topic"] > 100)
    until_read(SOUTH, by=NORTH)


def test_one_way_hall_sends_requests_and_gets_none(server, halls):
    with plants() as farm:
        line = f'mqtt: "mqtt://{BROKER}", unidirectional: true'
        farm.run(write_plant(farm.folder, "office", "127.0.5.3", line))
        until_read(NORTH, by="127.0.5.3")
        asked = Ams("127.0.5.3.3.1:1001", "9.9.9.9.1.1:800", body=bytes(12))
        with PahoPeer(BROKER, "works", "9.9.9.9.1.1") as peer:
            peer.wait_for_router("127.0.5.3.1.1", "office")
            assert peer.ask("127.0.5.3.1.1", asked) == asked.answer(b"", DENIED)
        assert read("127.0.5.3", by=NORTH) == -NO_ROUTE


def test_broker_is_changed_removed_and_taken_back_while_the_station_runs(server, halls):
    west = "127.0.5.4"
    with plants() as farm:
        appliance = farm.run(write_plant(farm.folder, "west", west, 'mqtt: "mqtt://127.0.5.98"'))
        pids = [appliance.pid(name) for name in ("engine", "services")]
        assert read(NORTH, by=west) == -NO_ROUTE
        file = write_plant(farm.folder, "west", west)
        assert "  * MQTT network works: changed" in appliance.command("plan", str(file))
        assert "MQTT network works: changed): ok" in appliance.command("apply", str(file))
        until_read(NORTH, by=west)
        until_read(west, by=NORTH)

        begin, _, _ = file.read_text().partition("    routes:")
        file.write_text(begin)
        assert "MQTT network works: removed): ok" in appliance.command("apply", str(file))
        assert read(NORTH, by=west) == -NO_ROUTE
        wait_until(lambda: read(west, by=NORTH) < 0)  # it has told that it leaves
        assert "MQTT network works: added): ok" in appliance.command("rollback", str(file))
        until_read(NORTH, by=west)
        assert [appliance.pid(name) for name in ("engine", "services")] == pids

        os.kill(pids[1], signal.SIGKILL)
        appliance.wait_for_another("services", pids[1])
        until_read(NORTH, by=west)


@pytest.mark.root
def test_halls_without_a_way_between_their_networks_meet_at_the_broker(tmp_path):
    """The broker's host has a leg in both networks and forwards nothing."""
    with row(3) as (north, middle, south), plants() as farm:
        middle.ip("addr", "add", "10.88.171.1/24", "dev", "east0")
        south.ip("addr", "add", "10.88.171.2/24", "dev", "west0")
        with broker(tmp_path, "0.0.0.0", prefix=middle.prefix) as server:
            for name, address, own, other in (
                ("north", "10.88.170.1", north, "10.88.170.2"),
                ("south", "10.88.171.2", south, "10.88.171.1"),
            ):
                plant = write_plant(farm.folder, name, address, f'mqtt: "mqtt://{other}"')
                farm.run(plant, prefix=own.prefix)
            until_read("10.88.171.2", by="10.88.170.1", inside=north)
            until_read("10.88.170.1", by="10.88.171.2", inside=south)
            with pytest.raises(OSError, match="unreachable"):
                read("10.88.171.2", by="10.88.171.2", inside=north)
            server.stop()
            wait_until(lambda: read("10.88.171.2", "10.88.170.1", inside=north) == -UNREACHABLE)
            server.start()
            until_read("10.88.171.2", by="10.88.170.1", inside=north)
