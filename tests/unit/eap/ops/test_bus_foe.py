"""Files of slaves."""

from __future__ import annotations

import hashlib
import os
import random
import re
from types import SimpleNamespace

import pytest

from devicebus.errors import FoeError, MailboxClosedError
from devicebus.mailbox.conversation import MailboxMessage
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.foe import FoeOpcode, encode_message
from eap.codec.mailbox import MailboxType
from eap.errors import ConfigError, EnvironmentalError
from eap.ops import bus_foe, bus_session
from eap.ops.bus_foe import VendorReply, exchange, get_file, put_file
from eap.ops.bus_gateway import open_gateway
from eap.runtime.foe_restart import RESTARTS
from tests.support.fakegateway import FILE, FakeGateway
from tests.support.loopbus import LoopBus

pytestmark = pytest.mark.net

CONTENT = random.Random(1).randbytes(50_000)


@pytest.fixture
def bus():
    with LoopBus("drive").session() as session:
        yield session


@pytest.fixture
def reports():
    return []


def get(bus, name, target, reports):
    def report(done, total, restarts):
        del restarts
        reports.append((done, total))

    return get_file(bus, "drive", name, target, password=0, report=report)


def put(bus, source, name, reports):
    def report(done, total, restarts):
        del restarts
        reports.append((done, total))

    return put_file(bus, "drive", source, name, password=0, report=report)


def test_there_and_back(bus, tmp_path, reports):
    source, target = tmp_path / "a.bin", tmp_path / "b.bin"
    source.write_bytes(CONTENT)
    there = put(bus, source, "firmware.bin", reports)
    assert reports[0][1] == reports[-1][0] == len(CONTENT)
    back = get(bus, "firmware.bin", target, reports)
    assert reports[-1] == (len(CONTENT), len(CONTENT))
    assert target.read_bytes() == CONTENT
    digest = hashlib.sha256(CONTENT).hexdigest()
    for row in (there, back):
        assert (row.octets, row.sha256, row.name) == (50_000, digest, "firmware.bin")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.bin", "b.bin"]


def test_file_that_the_slave_lacks(bus, tmp_path, reports):
    target = tmp_path / "kept.bin"
    target.write_bytes(b"as it was")
    with pytest.raises(FoeError, match="file not found"):
        get(bus, "nothing.bin", target, reports)
    assert target.read_bytes() == b"as it was"
    assert [path.name for path in tmp_path.iterdir()] == ["kept.bin"]


def test_files_of_this_machine_that_do_not_work(bus, tmp_path, reports):
    with pytest.raises(EnvironmentalError, match="cannot be read"):
        put(bus, tmp_path / "nothing", "firmware.bin", reports)
    with pytest.raises(EnvironmentalError, match="cannot be written"):
        get(bus, "firmware.bin", tmp_path / "no" / "folder", reports)


def test_a_pipe_or_device_is_written_as_it_is(bus, tmp_path, reports):
    pipe, source = tmp_path / "pipe", tmp_path / "a.bin"
    source.write_bytes(CONTENT)
    put(bus, source, "firmware.bin", reports)
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    get(bus, "firmware.bin", pipe, reports)
    assert os.read(reader, 1 << 17) == CONTENT
    os.close(reader)
    assert pipe.is_fifo()


def test_a_link_stays_one_and_what_is_read_only_stays(bus, tmp_path, reports, monkeypatch):
    target, link = tmp_path / "b.bin", tmp_path / "link"
    target.write_bytes(b"as it was")
    link.symlink_to(target)
    get(bus, "firmware.bin", link, reports)
    assert link.is_symlink()
    content = target.read_bytes()
    assert content != b"as it was"
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(EnvironmentalError, match=r"b\.bin cannot be written: it is read only"):
        get(bus, "firmware.bin", target, reports)
    assert target.read_bytes() == content


def test_interrupted_transfer_reports_its_progress(tmp_path):
    source, target = tmp_path / "a.bin", tmp_path / "b.bin"
    source.write_bytes(FILE)

    def leave(done, total, restarts):
        del total, restarts
        if done > 500:
            raise KeyboardInterrupt

    with FakeGateway() as gateway, open_gateway("127.0.0.1", gateway.port, tcp=False) as bus:
        with pytest.raises(KeyboardInterrupt) as caught:
            put_file(bus, "drive", source, "f", password=0, report=leave)
        assert re.match(r"512 of 1024 bytes were written; FoE cannot", caught.value.__notes__[0])
        with pytest.raises(KeyboardInterrupt) as caught:
            get_file(bus, "drive", "f", target, password=0, report=leave)
        assert re.match(r"600 bytes were read; FoE cannot", caught.value.__notes__[0])
    assert [path.name for path in tmp_path.iterdir()] == ["a.bin"]


def test_name_that_does_not_fit_the_mailbox(bus, tmp_path, reports):
    source = tmp_path / "a.bin"
    source.write_bytes(CONTENT)
    with pytest.raises(ConfigError, match="file name 'xxx"):
        put(bus, source, "x" * 2000, reports)
    with pytest.raises(ConfigError, match="file name 'xxx"):
        get(bus, "x" * 2000, tmp_path / "b", reports)


def test_vendor_message_is_echoed(bus):
    reply = exchange(bus, "drive", 0x1234, 5, b"\1\2\3")
    assert reply == VendorReply(1001, 0x1234, 5, "010203")


@pytest.mark.parametrize("is_write", [True, False])
def test_transfer_interrupted_by_a_power_fault_begins_anew(
    tmp_path, reports, monkeypatch, is_write
):
    monkeypatch.setattr(bus_foe, "PAUSE_S", 0)
    source, target = tmp_path / "a.bin", tmp_path / "b.bin"
    source.write_bytes(CONTENT)
    line = LoopBus("drive")
    with line.session() as bus:
        put(bus, source, "firmware.bin", reports)
        seen = []

        def interrupt(done, total, restarts):
            del total
            if done > 20_000 and 1 not in seen:
                line.fault(kind="power", slave="drive", for_ms=5)
                seen.append(1)
            seen.append(restarts)

        monkeypatch.setattr(bus_session, "REPORT_NS", 1)
        if is_write:
            row = put_file(bus, "drive", source, "firmware.bin", password=0, report=interrupt)
            get(bus, "firmware.bin", target, reports)
        else:
            row = get_file(bus, "drive", "firmware.bin", target, password=0, report=interrupt)
    assert (row.restarts, row.octets) == (1, len(CONTENT))
    assert row.sha256 == hashlib.sha256(CONTENT).hexdigest()
    assert target.read_bytes() == CONTENT
    assert seen[-1] == 1


class BrokenBus:
    """A bus that takes one packet of a file, and then has a fault."""

    def __init__(self):
        self.faults = 0

    def scan(self):
        return []

    def find(self, name):
        return SimpleNamespace(station=1001, name=name)

    def require_mailbox(self, slave):
        pass

    def converse(self, slave, begin, name, meanwhile=None):
        del slave, name, meanwhile
        conversation = begin(MailboxSizes(64, 64))
        next(conversation)
        for number in range(2):
            conversation.send(
                MailboxMessage(MailboxType.FOE, encode_message(FoeOpcode.ACK, number))
            )
        self.faults += 1
        raise MailboxClosedError("the slave's mailbox was closed")


def test_transfer_that_is_interrupted_repeatedly_fails(tmp_path, monkeypatch):
    monkeypatch.setattr(bus_foe, "PAUSE_S", 0)
    source = tmp_path / "a.bin"
    source.write_bytes(CONTENT)
    bus = BrokenBus()
    with pytest.raises(MailboxClosedError) as caught:
        put_file(bus, "drive", source, "f", password=0, report=lambda *_: None)
    assert bus.faults == 1 + RESTARTS
    notes = " ".join(caught.value.__notes__)
    assert f"the transfer restarted {RESTARTS} times, last after: the slave's mailbox" in notes
