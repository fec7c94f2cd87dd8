"""The variables of a running station as ADS symbols."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from eap.ads.request import AdsRefusedError
from eap.codec.ads import IndexGroup as G
from eap.codec.adssymbol import SymbolFlag
from eap.net.image_file import StationImage, create_image, open_image
from eap.pd.layout import plan_layout
from eap.pd.spec import VariableSpec, Writer
from eap.pd.words import StationWord
from eap.services.ads.station_symbols import StationSymbols
from tests.support.adstypes import decode_entries, decode_entry

BIG = 0xFFFF


@pytest.fixture
def station(images):
    return images["left"]


@pytest.fixture
def symbols(station):
    return StationSymbols(station)


def entry(symbols, name):
    return decode_entry(symbols.read_write(G.SYMBOL_ENTRY_BY_NAME, 0, BIG, name.encode()))[0]


def handle(symbols, name):
    return int.from_bytes(symbols.read_write(G.SYMBOL_HANDLE, 0, 4, name.encode()), "little")


def test_every_variable_is_a_symbol_of_its_type(symbols, station):
    names = list(decode_entries(symbols.read(G.SYMBOL_UPLOAD, 0, 1 << 20)))
    assert names == [place.name for place in station.image.layout.variables]
    setpoint = entry(symbols, "setpoint")
    assert (setpoint.type_name, setpoint.address.size) == ("ARRAY [0..1] OF REAL", 8)
    assert (setpoint.comment, setpoint.flags) == ("pressure [bar]", 0)
    assert entry(symbols, "load").flags & SymbolFlag.READ_ONLY


def test_values_are_those_of_the_image(symbols, files):
    with files["left"].image.writing(Writer.APPLICATION):
        files["left"].image.write("running", True)
    assert symbols.read_write(G.VALUE_BY_NAME, 0, BIG, b"running") == b"\1"
    symbols.write(G.VALUE_BY_HANDLE, handle(symbols, "name"), b"pump\0")
    assert files["left"].image.read("name") == "pump"


def test_variables_of_others_are_only_read(symbols):
    with pytest.raises(AdsRefusedError, match="ACCESS: load is written by the services"):
        symbols.write(G.VALUE_BY_HANDLE, handle(symbols, "load"), b"\0")


def test_text_in_another_encoding_stays_as_its_client_wrote_it(symbols):
    place = handle(symbols, "name")
    symbols.write(G.VALUE_BY_HANDLE, place, "größe\0".encode("latin-1"))
    assert symbols.read(G.VALUE_BY_HANDLE, place, 6) == "größe\0".encode("latin-1")
    assert entry(symbols, "name").attributes == (("TcEncoding", "UTF-8"),)


def test_variable_that_has_just_gone_is_refused(symbols, stations, files):
    store = symbols.store
    spec = replace(stations[0], variables=stations[0].variables[:1], frames=())
    gone = r"SYMBOL_VERSION: .*no variable 'running'"
    create_image(files["left"].path, plan_layout(spec)).close()
    with pytest.raises(AdsRefusedError, match=gone):
        store.write("running", b"\1")


def test_program_that_writes_keeps_others_out_for_now(symbols, files):
    with open_image(files["left"].path) as other:
        other.acquire_writer(Writer.APPLICATION)
        with pytest.raises(AdsRefusedError, match=r"BUSY: station left.* by process \d+"):
            symbols.write(G.VALUE_BY_HANDLE, handle(symbols, "running"), b"\1")


def test_variable_with_an_active_writer_is_busy(symbols, files):
    files["left"].image.words[StationWord.APPLICATION_SEQUENCE] += 1
    with pytest.raises(AdsRefusedError, match="BUSY: station left: the application stopped"):
        symbols.read(G.VALUE_BY_HANDLE, handle(symbols, "running"), 1)


def test_new_layout_is_a_new_version(symbols, stations, files):
    old = handle(symbols, "running")
    value = symbols.watch(G.VALUE_BY_HANDLE, old, 1)
    assert symbols.read(G.SYMBOL_VERSION, 0, 1) == b"\1"
    spec = replace(stations[0], variables=(VariableSpec("more", "UDINT"), *stations[0].variables))
    with create_image(files["left"].path, plan_layout(spec)) as fresh:
        assert symbols.read(G.SYMBOL_VERSION, 0, 1) == b"\2"
        with pytest.raises(AdsRefusedError, match="SYMBOL_VERSION"):
            symbols.read(G.VALUE_BY_HANDLE, old, 1)
        symbols.write(G.VALUE_BY_HANDLE, handle(symbols, "running"), b"\1")
        assert fresh.image.read("running") is True
        assert value() == b"\1"
        symbols.write(G.VALUE_BY_HANDLE, handle(symbols, "more"), b"\x08\0\0\0")


POINT = "ST_Point<8/4:x@0 REAL,y@4 REAL>"
AXIS = (
    "ST_Axis<24/4:state@0 E<INT:On=1>,bits@2.0 BIT1,mode@2.1 BIT3,name@4 STRING(4),"
    f"at@8 {POINT}[2]>"
)


def test_member_is_read_written_and_sampled_without_the_others(stations, tmp_path):
    variables = (VariableSpec("axis", AXIS), VariableSpec("speed", "INT"))
    layout = plan_layout(replace(stations[0], variables=variables, frames=()))
    with create_image(tmp_path / "axes", layout) as file:
        station = StationImage(file.path)
        symbols = StationSymbols(station)
        image = station.image
        # An enumeration without the number 0, as in fresh memory, and another encoding than ours.
        octets = b"\0\0\x0d\0\xe4\0\0\0" + bytes(range(16))
        symbols.write(G.VALUE_BY_HANDLE, handle(symbols, "axis"), octets)
        assert image.load("axis") == octets
        symbols.write(G.VALUE_BY_HANDLE, handle(symbols, "Axis.At[1].Y"), b"\0\0\x80\x3f")
        symbols.write(G.VALUE_BY_HANDLE, handle(symbols, "axis.mode"), b"\2")
        expected = b"\0\0\x05\0" + octets[4:20] + b"\0\0\x80\x3f"
        assert image.load("axis") == expected
        assert symbols.read_write(G.VALUE_BY_NAME, 0, BIG, b"axis.mode") == b"\2"
        for member, value in (("axis.state", b"\2\0"), ("axis.mode", b"\x08")):
            with pytest.raises(AdsRefusedError, match="VALUE"):
                symbols.write(G.VALUE_BY_HANDLE, handle(symbols, member), value)
        assert image.load("axis") == expected
        first = layout.samples.first
        sample = bytearray(image.memory[first : layout.samples.last])
        watched = symbols.watch(G.VALUE_BY_HANDLE, handle(symbols, "axis.at[1]"), 8)
        symbols.write(G.VALUE_BY_HANDLE, handle(symbols, "axis.at[1].y"), bytes(4))
        with symbols.store.reading(bytes(sample)):
            assert watched() == expected[16:]
        assert watched() == expected[16:20] + bytes(4)
        station.close()


def test_image_that_cannot_be_opened_is_not_ready(symbols, files):
    files["left"].path.unlink()
    files["left"].retire()
    with pytest.raises(AdsRefusedError, match=r"NOT_READY: .*no process image"):
        symbols.read(G.SYMBOL_VERSION, 0, 1)
