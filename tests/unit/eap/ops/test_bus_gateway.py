"""A bus behind a gateway, as commands use it."""

from __future__ import annotations

from functools import partial

import pytest

from devicebus.errors import BusError, MailboxSizeError
from devicebus.mailbox import coe_client, foe_client
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.master.diagnosis import diagnose
from devicebus.wire.alstatus import AlState
from eap.codec import datatypes
from eap.codec.soe import Idn
from eap.errors import ConfigError
from eap.gateway.client import GatewayClient
from eap.gateway.error_table import Cause
from eap.od.abort import SdoAbortError
from eap.ops import bus_gateway
from eap.ops.bus_foe import exchange, put_file
from eap.ops.bus_gateway import open_gateway
from eap.ops.bus_info import scan_slaves
from eap.ops.bus_objects import dump_entries, read_entry, read_idn, write_entry
from tests.support.fakegateway import FILE, SIZES, FakeGateway

pytestmark = pytest.mark.net

MODE = Idn.parse("S-0-0032")


NOT_A_SLAVE = "address {} is not a slave of this bus (1001 (drive))"


@pytest.fixture
def gateway():
    with FakeGateway() as running:
        yield running


@pytest.fixture
def bus(gateway):
    with open_gateway("127.0.0.1", gateway.port, tcp=False) as opened:
        yield opened


def test_slaves_and_the_master(bus) -> None:
    (row,) = scan_slaves(bus).slaves
    assert (row.address, row.name, row.state) == (1001, "drive", "OP")
    assert row.mailbox is None, "the usual dictionary ends before them"
    assert bus.find("drive").station == bus.find("1001").station == 1001
    assert bus.find("master").station == bus.find("0").station == 0
    with pytest.raises(BusError, match=r"unknown slave 'x'; known slaves: 1001 \(drive\)"):
        bus.find("x")
    with pytest.raises(ConfigError, match="65535 addresses all slaves"):
        bus.find("65535")


def test_gateway_scan_reads_protocols_from_a_full_dictionary() -> None:
    with (
        FakeGateway(full=True) as gateway,
        open_gateway("127.0.0.1", gateway.port, tcp=True) as bus,
    ):
        assert scan_slaves(bus).slaves[0].mailbox == ["CoE", "FoE"]


def test_virtual_addresses_are_passed_to_the_gateway(bus) -> None:
    slave = bus.find("0x9001")
    assert slave.station == 0x9001
    with pytest.raises(BusError, match="UNSUPPORTED_PROTOCOL") as caught:
        bus.converse(slave, lambda _: coe_client.upload(0x2000, 0), "x")
    assert caught.value.__notes__ == [NOT_A_SLAVE.format("0x9001")]


def test_files_go_in_packets_that_fill_the_mailbox(bus, tmp_path) -> None:
    source = tmp_path / "a"
    source.write_bytes(FILE)
    drive = bus.find(str(0x8000 | 1001))
    assert drive.station == 0x8000 | 1001
    bus.require_mailbox(drive)
    seen = []
    with pytest.raises(BusError, match="UNSUPPORTED_PROTOCOL"):  # this gateway knows no bit 15
        bus.converse(drive, lambda sizes: seen.append(sizes) or coe_client.upload(0x2000, 0), "x")
    assert (seen[0].to_slave, seen[0].to_master) == (SIZES.to_slave, SIZES.to_master)
    with pytest.raises(BusError, match="0x9001: the master does not describe its mailbox size"):
        put_file(bus, "0x9001", source, "f", password=0, report=lambda *_: None)


def test_mailboxes_behind_virtual_addresses_are_as_large_as_it_is_said(gateway) -> None:
    with open_gateway("127.0.0.1", gateway.port, tcp=False, mailbox=16) as bus:
        begin = partial(foe_client.read, "firmware.bin", bytearray().extend)
        with pytest.raises(MailboxSizeError, match="mailbox holds 4"):
            bus.converse(bus.find("0x9001"), begin, "x")


def test_objects(bus) -> None:
    write_entry(bus, "drive", 0x2000, 0, "77", kind=None, complete=False)
    assert read_entry(bus, "drive", 0x2000, 0, kind=None, complete=False).value == 77
    rows = list(dump_entries(bus, "0"))
    assert {row.index for row in rows} >= {0x1000, 0x8000, 0xA000, 0xF020}
    assert not any(row.error for row in rows), "gaps are left out"


def test_a_gateway_whose_master_has_no_dictionary(gateway, bus) -> None:
    gateway.has_master = False
    slave = bus.find("1001")
    assert len(bus.converse(slave, lambda _: coe_client.upload(0x2000, 0), "x")) == 4
    with pytest.raises(BusError):
        bus.find("drive")


@pytest.fixture
def silent_at_master(gateway, monkeypatch):
    monkeypatch.setattr(
        bus_gateway, "GatewayClient", partial(GatewayClient, timeout_s=0.01, tries=20)
    )
    gateway.is_master_silent = True
    with open_gateway("127.0.0.1", gateway.port, tcp=False) as opened:
        yield opened


def test_slave_by_station_address_never_asks_the_master(gateway, silent_at_master) -> None:
    bus = silent_at_master
    write_entry(bus, "1001", 0x2000, 0, "77", kind=None, complete=False)
    text = datatypes.parse("STRING(500)")
    write_entry(bus, "1001", 0x1008, 0, "y" * 400, kind=text, complete=False)
    assert read_entry(bus, "1001", 0x1008, 0, kind=text, complete=False).value == "y" * 400
    assert {row.index for row in dump_entries(bus, "0x3E9")} == {0x1008, 0x2000}
    assert read_idn(bus, "1001", MODE, drive=0).value == 7
    assert exchange(bus, "1001", 0x1164, 1, b"\1\2").data == "0102"
    assert set(gateway.addresses) == {1001}


def test_object_for_a_mailbox_that_is_smaller_than_usual_is_written_in_more_pieces() -> None:
    text = datatypes.parse("STRING(500)")
    with (
        FakeGateway(sizes=MailboxSizes(64, 64)) as gateway,
        open_gateway("127.0.0.1", gateway.port, tcp=False) as bus,
    ):
        write_entry(bus, "1001", 0x1008, 0, "y" * 400, kind=text, complete=False)
        assert read_entry(bus, "1001", 0x1008, 0, kind=text, complete=False).value == "y" * 400


def test_refusal_of_a_slave_that_has_answered_asks_the_master_for_no_hint(gateway, bus) -> None:
    read_entry(bus, "1001", 0x2000, 0, kind=None, complete=False)
    with pytest.raises(SdoAbortError) as caught:
        read_entry(bus, "1001", 0x2001, 0, kind=None, complete=False)
    assert not hasattr(caught.value, "__notes__")
    assert set(gateway.addresses) == {1001}


def test_refusal_of_a_slave_that_the_master_does_not_know_has_a_hint(gateway, bus) -> None:
    gateway.aborts_for = 1009  # as a gateway may, for want of a better error
    with pytest.raises(SdoAbortError) as caught:
        read_entry(bus, "1009", 0x1018, 1, kind=None, complete=False)
    hint = NOT_A_SLAVE.format(1009) + "; it may be a virtual address of the plant file"
    assert caught.value.__notes__ == [hint]


@pytest.mark.parametrize(
    ("cause", "hint"),
    [
        (Cause.TIMEOUT, "gateway status"),
        (Cause.UNREACHABLE, "eapctl trace"),
        (Cause.DENIED, ""),
        (Cause.NO_MAILBOX, "is not a slave of this bus"),
        (Cause.LENGTH, ""),
    ],
)
def test_refusal_for_another_reason_has_no_hint_about_the_address(
    gateway, bus, cause, hint
) -> None:
    gateway.aborts_for, gateway.aborts_with = 0x9001, cause
    with pytest.raises(SdoAbortError) as caught:
        read_entry(bus, "0x9001", 0x1018, 1, kind=None, complete=False)
    notes = getattr(caught.value, "__notes__", [])
    assert not any("virtual" in note for note in notes)
    assert [hint in note for note in notes] == ([True] if hint else [])


def test_slave_by_name_with_a_silent_master_has_a_remedy(silent_at_master):
    with pytest.raises(BusError, match=r"does not list its slaves: no answer .* such as 1001"):
        silent_at_master.find("drive")


def test_file_of_a_slave_where_the_master_is_silent_needs_the_mailbox(
    gateway, silent_at_master, tmp_path
) -> None:
    source = tmp_path / "a"
    source.write_bytes(FILE)
    with pytest.raises(BusError, match=r"no answer from address 0.*--mailbox BYTES"):
        put_file(silent_at_master, "1001", source, "f", password=0, report=lambda *_: None)
    gateway.addresses.clear()
    with open_gateway("127.0.0.1", gateway.port, tcp=False, mailbox=SIZES.to_slave) as bus:
        done = put_file(bus, "1001", source, "f", password=0, report=lambda *_: None)
    assert done.octets == len(FILE)
    assert set(gateway.addresses) == {1001}


def test_gateway_bus_refuses_requests_other_than_mailbox_messages(bus) -> None:
    for call in (
        lambda: bus.run(diagnose([1001]), "registers"),
        bus.frame_counts,
        lambda: bus.bring([], AlState.OP),
    ):
        with pytest.raises(BusError, match="only mailbox messages"):
            call()
