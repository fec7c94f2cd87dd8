from __future__ import annotations

import msgspec
import pytest

from eap.ids import NetId, decode_value, encode_value
from eap.pd.layout import ImageLayout, plan_layout
from eap.pd.spec import (
    INTERFACE_MEASURES,
    RECORDS_PER_STEP,
    CounterSource,
    GatewayAddress,
    GatewaySpec,
    HostSource,
    Measure,
    OnChangeSpec,
    RandomSource,
    RxPdSpec,
    SineSource,
    StationSpec,
    Substitute,
    TriggerSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
    encode_in_steps,
    record_from_lines,
    record_to_lines,
)
from tests.support.cyclic import PEER, eap_port, station

STATION = StationSpec(
    "island-01",
    NetId.parse("5.1.1.1.1.1"),
    10_000,
    (eap_port(),),
    variables=(
        VariableSpec("load", "REAL", Writer.SERVICES, unit="1"),
        VariableSpec("n", "UINT", Writer.ENGINE, default=7),
        VariableSpec("matrix", "INT[2]", default=[1, -1]),
    ),
    sources=(
        CounterSource("n"),
        HostSource("load", Measure.LOAD1),
        SineSource("s", 1.0, 100.0),
        RandomSource("r", seed=3),
    ),
    frames=(
        TxFrameSpec(
            "f",
            "eap0",
            "239.0.0.1",
            (TxPdSpec("p", 1, ("n",), trigger=TriggerSpec(on_change=OnChangeSpec(5, 10))),),
        ),
    ),
    subscriptions=(RxPdSpec("r", "eap0", 9, ("x",), timeout_ms=30, substitute=Substitute.DEFAULT),),
)


def test_a_station_crosses_to_the_engine_as_json_unchanged():
    text = msgspec.json.encode(STATION, enc_hook=encode_value)
    assert msgspec.json.decode(text, type=StationSpec, dec_hook=decode_value) == STATION


def test_a_field_of_another_release_is_refused():
    text = msgspec.json.encode(STATION, enc_hook=encode_value).replace(b'"phase_us"', b'"phase_ms"')
    with pytest.raises(msgspec.ValidationError, match="phase_ms"):
        msgspec.json.decode(text, type=StationSpec, dec_hook=decode_value)


def test_measures_of_interfaces_are_those_of_octets_and_packets():
    assert {measure.value for measure in INTERFACE_MEASURES} == {
        f"{way}_{what}" for way in ("rx", "tx") for what in ("octets", "packets")
    }


def test_a_specification_crosses_as_json():
    told = GatewaySpec(silent=True, addresses=(GatewayAddress(0x9000, members=(1001, 1002)),))
    assert msgspec.json.decode(msgspec.json.encode(told), type=GatewaySpec) == told


def test_spec_rejects_unknown_fields():
    with pytest.raises(msgspec.ValidationError):
        msgspec.json.decode(b'{"quiet": true}', type=GatewaySpec)


def spec(count: int) -> StationSpec:
    return station(
        variables=tuple(VariableSpec(f"v{n}", "INT", Writer.ENGINE) for n in range(count)),
        subscriptions=tuple(
            RxPdSpec(f"p{n}", "eap0", n, (f"v{n}",), PEER, version=n) for n in range(count)
        ),
    )


@pytest.mark.parametrize(
    "count", [0, 1, RECORDS_PER_STEP, RECORDS_PER_STEP + 1, 3 * RECORDS_PER_STEP - 1]
)
def test_specification_survives_lines(count):
    given = spec(count)
    assert record_from_lines(record_to_lines(given), StationSpec) == given
    layout = plan_layout(given)
    assert msgspec.json.decode(encode_in_steps(layout), type=ImageLayout) == layout
    assert encode_in_steps(layout) == msgspec.json.encode(layout)


def test_no_line_is_long():
    lines = record_to_lines(spec(10 * RECORDS_PER_STEP)).split(b"\n")
    assert len(lines) == 1 + 1 + 20  # the rest, one port, ten times variables and subscriptions
    assert max(map(len, lines)) < 300 * RECORDS_PER_STEP


@pytest.mark.parametrize("octets", [b"", b"{}", b'{"name":1}', b"\xff"])
def test_anything_else_is_no_record(octets):
    with pytest.raises((msgspec.MsgspecError, UnicodeDecodeError)):
        record_from_lines(octets, StationSpec)


def test_record_from_lines_rejects_unknown_field():
    with pytest.raises(KeyError, match="wheels"):
        record_from_lines(record_to_lines(spec(1)) + b"\nwheels []", StationSpec)
