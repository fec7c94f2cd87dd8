"""Attacks on process data, ADS and gateway of the hardened plant, from hosts of its network.

The page docs/security.md lists each with its effect; what it says of an attack is tested here.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator
from contextlib import ExitStack, suppress

import pytest

from eap.codec.ads import IndexGroup
from eap.codec.ams import CONTROL_PORT
from eap.config.pd_keys import read_keys
from eap.pd.authentication import SIGNATURE_ID, SIGNATURE_SIZE, KeyRing
from eap.pd.link import OutFrame
from tests.support import aoe
from tests.support.amsclient import AmsClient
from tests.support.appliance import wait_until
from tests.support.cyclic import octets
from tests.support.hardenedplant import (
    ATTACKER,
    BUS_ID,
    ENGINEER,
    OTHER,
    OVEN,
    OVEN_ID,
    PANEL,
    PANEL_ID,
    SecureClient,
    Site,
    hardened_plant,
)
from tests.support.vectors import load

pytestmark = [pytest.mark.net, pytest.mark.root]

DENIED = 0x723
(ADD_ROUTE, SERVER_INFO) = (vector.octets for vector in load("ams_discovery"))


@pytest.fixture(scope="module")
def site() -> Iterator[Site]:
    with hardened_plant() as found:
        yield found


# Process data


def test_frames_of_a_forged_publisher_are_dropped_by_their_address(site: Site) -> None:
    before = site.discarded().get("wrong_source", 0)
    with site.udp(ATTACKER) as sock:
        sock.sendto(octets([(2, b"\xff" * 4)], publisher=PANEL_ID), (OVEN, 34980))
        wait_until(lambda: site.discarded().get("wrong_source", 0) > before)
    assert site.oven.rx("oven", "panel")["wrong_source"]["address"] == ATTACKER
    assert site.oven.values("oven")["panel.level"] < 0xFFFFFFFF
    assert ATTACKER in site.oven.command("status", "--full")


def signed(site: Site, at_ns: int) -> bytearray:
    """Return a frame of the panel with a right signature."""
    blank = octets([(2, b"\xff" * 4), (SIGNATURE_ID, bytes(SIGNATURE_SIZE), 1)], publisher=PANEL_ID)
    frame = OutFrame(bytearray(blank), 0, "", len(blank) - SIGNATURE_SIZE)
    KeyRing(read_keys(site.folder / "plant.keys")).sign(frame, at_ns)
    return frame.buffer


def test_frames_with_a_forged_address_are_dropped_by_their_signature(site: Site) -> None:
    recorded = signed(site, 1)
    changed = bytearray(recorded)
    changed[20] ^= 1
    before = site.discarded()
    with site.udp(PANEL) as sock:
        for data in (octets([(2, b"\xff" * 4)], publisher=PANEL_ID), changed, recorded):
            sock.sendto(data, (OVEN, 34980))
    reasons = ("unsigned", "bad_tag", "replayed")
    expected = {why: before.get(why, 0) + 1 for why in reasons}
    wait_until(lambda: {why: site.discarded().get(why, 0) for why in reasons} == expected)
    site.goes_on()
    assert site.oven.values("oven")["panel.level"] < 0xFFFFFFFF
    assert "not authentic" in site.oven.command("status", "--full")


def test_flood_of_frames_leaves_values_and_cycles(site: Site) -> None:
    junk = octets([(2, b"\xff" * 4)], publisher=PANEL_ID)
    with site.udp(ATTACKER) as sock:
        for number in range(20_000):
            sock.sendto(junk if number % 2 else os.urandom(60), (OVEN, 34980))
    site.goes_on()
    assert site.oven.rx("oven", "panel")["state"] == "running"
    assert site.oven.values("oven")["panel.level"] < 0xFFFFFFFF
    assert site.oven.station("oven")["discarded"]


def test_cut_line_ages_the_values_and_is_counted(site: Site) -> None:
    before = site.oven.rx("oven", "panel")["timeouts"]
    site.there.unplug()
    try:
        wait_until(lambda: site.oven.rx("oven", "panel")["timeouts"] > before)
        assert site.oven.request("read", station="oven")["stale"] == ["panel.level"]
    finally:
        site.there.plug()
    site.goes_on()


# ADS


def write(client: AmsClient | SecureClient, target: str = OVEN_ID, port: int = aoe.DEVICE) -> int:
    """Return the error or result of a write of an object."""
    error, data = client.ask(target, aoe.WRITE, aoe.write_body(0x8000_0001, b"\1\0"), port=port)
    return error or int.from_bytes(data[:4], "little")


def test_foreign_hosts_neither_write_nor_read(site: Site) -> None:
    with site.ams(ATTACKER) as client:
        assert write(client) == DENIED
        assert write(client, BUS_ID, 1001) == DENIED
        error, data = client.ask(OVEN_ID, aoe.READ, aoe.read_body(0x1018_0001, 4))
        assert (error or int.from_bytes(data[:4], "little")) == DENIED
        error, data = client.ask(OVEN_ID, aoe.READ_STATE, b"")
        assert (error or int.from_bytes(data[:4], "little")) == DENIED
    line = next(each for each in site.audit() if each["from"].startswith(ATTACKER))
    assert (line["allowed"], line["why"]) == (False, "rule rest refuses it")


def test_forged_net_id_of_an_engineer_changes_nothing(site: Site) -> None:
    """A source NetID proves nothing: the packet names the engineer's computer."""
    body = aoe.write_body(0x8000_0001, b"\1\0")
    packet = bytearray(aoe.packet(OVEN_ID, aoe.WRITE, body))
    packet[8:14] = aoe.net_id(f"{ENGINEER}.1.1")
    with site.ams(ATTACKER) as client:
        client._number = 1
        client.send(bytes(packet))
        error, data = client.receive()
        assert (error or int.from_bytes(data[:4], "little")) == DENIED
    with site.udp(ATTACKER) as sock:
        sock.sendto(aoe.frame(bytes(packet)), (OVEN, 34980))
        answer = aoe.answer(sock.recv(2048))
        assert (answer.error or int.from_bytes(answer.data[:4], "little")) == DENIED


def test_datagrams_with_the_address_of_the_engineer_change_nothing(site: Site) -> None:
    """Blind writes: the attacker needs no answers, so nothing else would stop it."""
    frame = aoe.frame(aoe.packet(OVEN_ID, aoe.WRITE, aoe.write_body(0x8000_0001, b"\1\0")))
    with site.udp(ENGINEER) as sock:
        sock.sendto(frame, (OVEN, 34980))
        answer = aoe.answer(sock.recv(2048))
    assert (answer.error or int.from_bytes(answer.data[:4], "little")) == DENIED
    assert site.audit()[-1]["transport"] == "udp:eap0"


def test_host_with_a_known_address_reads_and_does_no_more(site: Site) -> None:
    with site.ams(PANEL) as client:
        error, data = client.ask(OVEN_ID, aoe.READ, aoe.read_body(0x1018_0001, 4))
        assert (error, data[:4]) == (0, bytes(4))
        assert write(client) == DENIED


def test_engineer_is_known_by_the_certificate_and_not_by_the_address(site: Site) -> None:
    with site.ams(ENGINEER) as client:
        assert write(client, BUS_ID, 1001) == DENIED
    with site.engineer() as client:
        assert client.error == 0
        assert write(client, BUS_ID, 1001) != DENIED
    line = site.audit()[-1]
    assert (line["transport"], line["why"]) == ("ams-tls:anna", "rule engineers allows it")


@pytest.mark.parametrize(
    ("name", "flags", "counter"),
    [
        ("", 0, "tls_certificate"),
        ("rogue", 0, "tls_certificate"),
        ("evil", 0x10, "tls_fingerprint"),
    ],
)
def test_secure_ads_refuses_others(site: Site, name: str, flags: int, counter: str) -> None:
    before = site.oven.station("oven")["discarded"].get(counter, 0)
    with suppress(OSError), SecureClient(site.tcp(ATTACKER, 8016), site.folder, name, flags) as one:
        assert one.error != 0
        one.ask(OVEN_ID, aoe.READ_STATE, b"")
        raise AssertionError("answered")
    wait_until(lambda: site.oven.station("oven")["discarded"].get(counter, 0) > before)


def test_flood_of_connections_leaves_room_for_others(site: Site) -> None:
    with ExitStack() as stack:
        for _ in range(60):
            with suppress(OSError):
                stack.enter_context(site.tcp(ATTACKER, 48898))
        with site.ams(PANEL) as client:
            assert client.ask(OVEN_ID, aoe.READ_STATE, b"")[0] == 0
        (listener,) = (
            each for each in site.oven.status()["listeners"] if each["name"].startswith("ams-tcp")
        )
        assert listener["refused"] + listener["evicted"] > 0
        assert listener["open"] <= 40


def test_add_route_is_refused_audited_and_its_flood_unanswered(site: Site) -> None:
    before = site.oven.station("oven")["discarded"].get("ams_discovery", 0)
    answers, lines = 0, len(site.audit())
    with site.udp(OTHER) as sock:
        for _ in range(200):
            sock.sendto(ADD_ROUTE, (OVEN, 48899))
        with suppress(TimeoutError):
            while True:
                assert b"\x04\x07\x00\x00" in sock.recv(400)  # refused
                answers += 1
    assert 1 <= answers < 30
    wait_until(lambda: site.oven.station("oven")["discarded"]["ams_discovery"] > before + 100)
    denied = site.audit()[lines:]
    assert not any(line["allowed"] for line in denied)
    assert any("only this host may add routes" in line["why"] for line in denied)
    (row,) = json.loads(site.oven.command("routes", "list", "oven", "--json"))["stations"]
    assert "added" not in {route["origin"] for route in row["routes"]}


def test_discovery_does_not_amplify(site: Site) -> None:
    with site.udp(ATTACKER) as sock:
        sock.sendto(SERVER_INFO, (OVEN, 48899))
        assert len(sock.recv(400)) < 3 * len(SERVER_INFO)


def test_configuration_and_control_protocol_are_closed_to_others(site: Site) -> None:
    """Groups CONTROL and CONFIGURE of the control protocol by ADS."""
    request = json.dumps({"v": 1, "method": "status"}).encode()
    for group in (IndexGroup.CONTROL, IndexGroup.CONFIGURE):
        body = struct.pack("<IIII", group, 0, 4096, len(request)) + request
        with site.ams(ATTACKER) as client:
            error, data = client.ask(f"{OVEN}.1.1", 9, body, port=CONTROL_PORT)
            assert error or int.from_bytes(data[:4], "little")


def test_answers_to_a_forged_address_are_hardly_longer_than_the_request(site: Site) -> None:
    """Reads in the name of another host, which gets the answers."""
    body = aoe.read_body(0x1018_0100, 0xFFFF)
    frame = aoe.frame(aoe.packet(OVEN_ID, aoe.READ, body))
    with site.udp(PANEL) as sock:
        sock.sendto(frame, (OVEN, 34980))
        received = [sock.recv(2048)]
        with suppress(TimeoutError):
            while True:
                received.append(sock.recv(2048))
    assert sum(map(len, received)) < 4 * len(frame)


# Mailbox gateway


def test_flood_of_the_gateway_is_denied_and_audited_within_limits(site: Site) -> None:
    lines = len(site.audit())
    read = struct.pack("<HHBB", 10, 1001, 0, 0x13) + bytes.fromhex("0020 40 18 10 01 00000000")
    frame = struct.pack("<H", len(read) | 5 << 12) + read
    with site.udp(ATTACKER) as sock:
        for _ in range(3000):
            sock.sendto(frame, (OVEN, 34980))
        assert sock.recv(2048)[10:11] == b"\x80"  # abort
    with site.engineer() as client:
        error, data = client.ask(BUS_ID, aoe.READ, aoe.read_body(0x1018_0001, 4), port=1001)
        assert (error, data[:4]) == (0, bytes(4))
    assert 0 < len(site.audit()) - lines < 1200
    site.goes_on()


@pytest.mark.parametrize("name", ["../../../etc/passwd", "/etc/passwd", "..\\\\plant.keys"])
def test_path_traversal_by_foe_finds_nothing(site: Site, name: str) -> None:
    """Even an engineer reaches the files of the slave only."""
    data = name.encode()
    body = struct.pack("<IIII", IndexGroup.FOE_OPEN_READ, 0, 4, len(data)) + data
    with site.engineer() as client:
        error, answer = client.ask(BUS_ID, 9, body, port=1001)
    assert error or int.from_bytes(answer[:4], "little")
