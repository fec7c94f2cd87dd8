"""Objects of slaves as plain data."""

from __future__ import annotations

import msgspec
import pytest

from devicebus.errors import MailboxProtocolError
from devicebus.mailbox.coe_client import entry_description
from eap.codec import datatypes
from eap.errors import ConfigError
from eap.od.abort import AbortCode, SdoAbortError
from eap.ops.bus_objects import dump_entries, list_objects, read_entry, write_entry
from tests.support.loopbus import LoopBus


@pytest.fixture
def bus():
    with LoopBus("coe").session() as session:
        yield session


def read(bus, index, subindex=0, kind=None, *, complete=False):
    kind = datatypes.parse(kind) if kind else None
    return read_entry(bus, "sensor", index, subindex, kind=kind, complete=complete)


def write(bus, index, subindex, text, kind=None, *, complete=False):
    kind = datatypes.parse(kind) if kind else None
    return write_entry(bus, "sensor", index, subindex, text, kind=kind, complete=complete)


@pytest.mark.parametrize(
    ("place", "kind", "expected"),
    [
        ((0x1018, 1), None, ("UDINT", 0xE5A, "5a0e0000")),
        ((0x1018, 1), "REAL", ("REAL", pytest.approx(5.1e-42, rel=0.1), "5a0e0000")),
        ((0x1018, 1), "UINT", ("UINT", None, "5a0e0000")),
        ((0x1008, 0), None, ("STRING(6)", "sensor", b"sensor".hex())),
        ((0x8001, 0), None, ("BLOCK(2048)", "00" * 2048, "00" * 2048)),
        ((0x8000, 2), None, ("INT", 1000, "e803")),
    ],
)
def test_read(bus, place, kind, expected):
    row = read(bus, *place, kind)
    assert (row.type, row.value, row.data) == expected
    assert (row.slave, row.index, row.subindex) == (1003, *place)


def test_complete_access(bus):
    row = read(bus, 0x8000, complete=True)
    assert (row.value, row.data) == (None, "020032000000e803")
    write(bus, 0x8000, 0, "0200 07000000 0500", complete=True)
    assert read(bus, 0x8000, 1).value == 7


def test_write(bus):
    assert write(bus, 0x8000, 2, "-77").data == "b3ff"
    assert read(bus, 0x8000, 2).value == -77
    write(bus, 0x8000, 1, "0x10", "UDINT")
    assert read(bus, 0x8000, 1).value == 16


@pytest.mark.parametrize(
    ("place", "code"),
    [
        ((0x8000, 9), AbortCode.NO_SUBINDEX),
        ((0x5555, 0), AbortCode.NO_OBJECT),
    ],
)
def test_refused_read(bus, place, code):
    with pytest.raises(SdoAbortError) as caught:
        read(bus, *place)
    assert caught.value.code == code


def test_refused_write(bus):
    with pytest.raises(SdoAbortError, match="above the maximum"):
        write(bus, 0x8000, 2, "30000")
    with pytest.raises(SdoAbortError, match="read-only"):
        write(bus, 0x1018, 1, "1")


@pytest.mark.parametrize(
    ("text", "complete", "reason"),
    [("abc", False, "0x8000:01: 'abc' is not a value of UDINT"), ("xy", True, "hexadecimal")],
)
def test_value_that_is_none(bus, text, complete, reason):
    with pytest.raises(ConfigError, match=reason):
        write(bus, 0x8000, 1, text, complete=complete)


def test_unknown_data_type_is_refused(bus):
    with pytest.raises(ConfigError, match="--type"):
        write(bus, 0x5555, 1, "1")


def test_list(bus):
    rows = {row.index: row for row in list_objects(bus, "sensor")}
    assert msgspec.to_builtins(rows[0x1018]) == {
        "index": 0x1018,
        "name": "Identity",
        "code": "RECORD",
        "data_type": 0x23,
        "max_subindex": 4,
    }
    assert 0x8001 in rows


def test_dump(bus):
    rows = {(row.index, row.subindex): row for row in dump_entries(bus, "sensor")}
    assert msgspec.to_builtins(rows[0x8000, 2]) == {
        "index": 0x8000,
        "subindex": 2,
        "object": "Settings",
        "name": "Upper limit",
        "access": "rw",
        "type": "INT",
        "value": 1000,
        "data": "e803",
    }


def test_dump_continues_after_an_invalid_description(bus, monkeypatch):
    def short_answer(index, subindex):
        if subindex == 1:
            raise MailboxProtocolError("InfoError at offset 6: needs 4 bytes, but 0 follow")
        return (yield from entry_description(index, subindex))

    monkeypatch.setattr("devicebus.mailbox.coe_client.entry_description", short_answer)
    rows = {(row.index, row.subindex): row for row in dump_entries(bus, "sensor")}
    assert "needs 4 bytes" in rows[0x8000, 1].error
    assert rows[0x8000, 2].value == 1000
    assert read(bus, 0x1018, 1).value == 0xE5A


def test_dump_continues_after_a_refused_entry():
    line = LoopBus("coe")
    line.fault(kind="sdo", slave="sensor", object="0x8000", code=AbortCode.HARDWARE)
    with line.session() as bus:
        rows = {(row.index, row.subindex): row for row in dump_entries(bus, "sensor")}
    assert "hardware" in rows[0x8000, 1].error
    assert len(rows[0x8001, 0].value) == 4096
