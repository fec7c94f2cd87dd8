"""IDNs of drives as plain data."""

from __future__ import annotations

import pytest

from devicebus.errors import SoeError
from eap.codec.soe import Idn
from eap.errors import ConfigError
from eap.ops.bus_objects import list_idns, read_idn, write_idn
from tests.support.loopbus import LoopBus


@pytest.fixture
def bus():
    with LoopBus("drive").session() as session:
        yield session


def test_read(bus):
    row = read_idn(bus, "drive", Idn.parse("S-0-0032"), drive=0)
    assert (row.idn, row.name, row.value) == ("S-0-0032", "Primary operation mode", 2)
    assert (row.octets, row.is_list, row.display) == (4, False, "UNSIGNED")
    assert (row.data_state, row.factor, row.protected_in) == (None, 1, [])
    command = read_idn(bus, "drive", Idn.parse("S-0-0099"), drive=0)
    assert (command.is_command, command.data_state) == (True, 0)
    status = read_idn(bus, "drive", Idn.parse("S-0-0135"), drive=0)
    assert status.protected_in == ["PREOP", "SAFEOP", "OP"]


def test_write(bus):
    idn = Idn.parse("S-0-0032")
    assert write_idn(bus, "drive", idn, "0x5", drive=0).value == 5
    assert read_idn(bus, "drive", idn, drive=0).value == 5


def test_list_of_idns_is_written(bus):
    idn = Idn.parse("S-0-0024")
    before = read_idn(bus, "drive", idn, drive=0)
    text = ",".join(map(str, before.value))
    assert before.is_list
    assert write_idn(bus, "drive", idn, text, drive=0).value == before.value


def test_text_is_read(bus):
    assert isinstance(read_idn(bus, "drive", Idn.parse("S-0-0030"), drive=0).value, str)


def test_refusals(bus):
    with pytest.raises(SoeError, match="no such IDN"):
        read_idn(bus, "drive", Idn.parse("P-0-4000"), drive=0)
    with pytest.raises(SoeError):
        write_idn(bus, "drive", Idn.parse("S-0-0051"), "1", drive=0)


@pytest.mark.parametrize(("idn", "text"), [("S-0-0032", "abc"), ("S-0-0024", "1,x")])
def test_value_that_is_none(bus, idn, text):
    with pytest.raises(ConfigError, match=f"{idn}: '{text}' is no value of it"):
        write_idn(bus, "drive", Idn.parse(idn), text, drive=0)


def test_value_that_does_not_fit(bus):
    with pytest.raises(ConfigError, match="4 bytes"):
        write_idn(bus, "drive", Idn.parse("S-0-0032"), str(1 << 40), drive=0)


def test_list(bus):
    rows = {row.idn: row.name for row in list_idns(bus, "drive", drive=0)}
    assert rows["S-0-0047"] == "Position command value"
