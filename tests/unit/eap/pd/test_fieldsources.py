"""Sources in controllers: time-outs, substitutes, states, and the quality of frames with them."""

from math import isnan

import msgspec
import pytest

from eap.codec.pd import PdHeader
from eap.ids import NetId
from eap.pd.fieldsources import NEVER_MS, FieldSources
from eap.pd.image import format_image
from eap.pd.layout import plan_layout
from eap.pd.quality import QUALITY_MAX, field_quality, find_origins, forwarded_quality, is_late
from eap.pd.report import station_status
from eap.pd.spec import LinkSpec, S7Source, StationSpec, Substitute, VariableSpec, Writer
from eap.pd.words import StationWord

MS = 1_000_000
PAIR = "S<8/4:a@0 REAL,b@4 REAL>"


def source(name: str, substitute: Substitute, timeout_ms: int = 100) -> S7Source:
    return S7Source(name, "press", "DB1.DBD0", timeout_ms=timeout_ms, substitute=substitute)


STATION = StationSpec(
    name="one",
    net_id=NetId.parse("1.2.3.4.1.1"),
    cycle_us=10_000,
    ports=(),
    variables=(
        VariableSpec("held", "REAL", Writer.SERVICES, 1.0),
        VariableSpec("zeroed", "REAL", Writer.SERVICES, 2.0),
        VariableSpec("pair", PAIR, Writer.SERVICES, {"a": 3.0, "b": 4.0}),
        VariableSpec("press.ok", "BOOL", Writer.SERVICES),
        VariableSpec("press.age_ms", "UDINT", Writer.SERVICES),
        VariableSpec("copy", "REAL", Writer.ENGINE),
    ),
    sources=(
        source("held", Substitute.HOLD),
        source("zeroed", Substitute.ZERO),
        source("pair.b", Substitute.DEFAULT, 300),
    ),
    links=(LinkSpec("held", "copy"),),
)
READ = {"held": 5.0, "zeroed": 6.0, "pair.b": 7.0}


def test_controller_that_was_never_read_is_late_and_substitutes_nothing() -> None:
    sources = FieldSources(STATION)
    assert sources.check(0) == {"press.ok": False, "press.age_ms": NEVER_MS}
    assert sources.moments() == dict.fromkeys(READ, 0)


def test_values_are_good_until_their_time_out_then_substituted_once() -> None:
    sources = FieldSources(STATION)
    assert sources.fill(READ, 1000 * MS) == READ | {"press.ok": True, "press.age_ms": 0}
    assert sources.check(1100 * MS) == {"press.ok": True, "press.age_ms": 100}
    assert sources.check(1101 * MS) == {"zeroed": 0.0, "press.ok": False, "press.age_ms": 101}
    assert sources.check(1300 * MS) == {"press.ok": False, "press.age_ms": 300}
    assert sources.check(1301 * MS) == {"pair.b": 4.0, "press.ok": False, "press.age_ms": 301}
    assert sources.fill(READ, 1400 * MS)["press.ok"] is True


def test_value_that_fails_alone_makes_its_controller_late() -> None:
    sources = FieldSources(STATION)
    sources.fill(READ, 0)
    sources.fill({"held": 5.5}, 200 * MS)
    found = sources.check(200 * MS)
    assert (found["press.ok"], found["press.age_ms"]) == (False, 200)


def test_wrong_value_is_refused_and_nothing_taken() -> None:
    sources = FieldSources(STATION)
    with pytest.raises(ValueError, match="zeroed: 'x' is not a value of REAL"):
        sources.fill({"held": 1.0, "zeroed": "x"}, 5)
    assert sources.moments()["held"] == 0
    assert sources.unknown(["held", "copy"]) == ["copy"]


def test_null_is_nan_and_disturbs_no_other_value() -> None:
    filled = FieldSources(STATION).fill(READ | {"held": None}, 5)
    assert isnan(filled["held"])
    assert filled["zeroed"] == 6.0


def test_changed_station_keeps_the_ages_of_sources_that_stay() -> None:
    before = FieldSources(STATION)
    before.fill(READ, 50 * MS)
    changed = msgspec.structs.replace(
        STATION, sources=(source("held", Substitute.ZERO), STATION.sources[1])
    )
    after = FieldSources(changed, before)
    assert after.moments() == {"held": 0, "zeroed": 50 * MS}
    resumed = FieldSources(STATION)
    resumed.resume({"zeroed": 50 * MS, "gone": 3})
    assert resumed.check(300 * MS)["zeroed"] == 0.0


def test_quality_of_frames_and_status_tell_the_age() -> None:
    layout = plan_layout(STATION)
    image = format_image(memoryview(bytearray(layout.size)), layout, 1)
    origins = find_origins(layout, STATION.links)
    quality = forwarded_quality(image, ["copy", "pair"], origins)
    assert quality is not None
    buffer = memoryview(bytearray(PdHeader.SIZE))
    quality.into(buffer, PdHeader.SIZE)
    assert PdHeader.decode(buffer).quality == QUALITY_MAX
    slots = {slot.variable: slot for slot in layout.fields}
    image.words[StationWord.CYCLE_AT_NS] = 1000 * MS
    image.words[slots["held"].words] = 950 * MS
    image.words[slots["pair.b"].words] = 1010 * MS
    quality.into(buffer, PdHeader.SIZE)
    assert PdHeader.decode(buffer).quality == 500
    assert field_quality(image, slots["pair.b"]) == 0
    assert [is_late(image, slots[name]) for name in READ] == [False, True, False]
    assert station_status(image, 1000 * MS)["controllers"] == [
        {"name": "press", "sources": 3, "late": 1, "age_us": None}
    ]
