"""What is kept of a station: the digest of a specification, and the file."""

from __future__ import annotations

import msgspec
import pytest
from msgspec.structs import replace

from eap.appliance.configuration import (
    VERSION,
    Configuration,
    Stored,
    decode_stored,
    digest_of,
    encode_stored,
)
from eap.appliance.durable import seal
from eap.errors import ConfigError
from eap.pd.device import DeviceState


@pytest.fixture
def stored(stations) -> Stored:
    left, right = stations
    before = Configuration(base="b0", spec=right, objects={"eap0": [1]})
    return Stored(
        base="b1",
        spec=left,
        objects={"eap0": {"1A00": "00"}},
        state=DeviceState.SAFEOP,
        previous=before,
    )


def test_round_trip(stored):
    assert decode_stored(encode_stored(stored)) == stored


@pytest.mark.parametrize("cut", [0, 1, 10, 200, -1])
def test_cut_file_is_refused(stored, cut):
    with pytest.raises(ConfigError, match="not whole"):
        decode_stored(encode_stored(stored)[:cut])


def test_changed_octet_is_refused(stored):
    data = encode_stored(stored).replace(b"setpoint", b"setpaint")
    with pytest.raises(ConfigError, match="not what was written"):
        decode_stored(data)


def test_other_version_is_refused(stored):
    data = encode_stored(stored).replace(b'"version":1', b'"version":9')
    with pytest.raises(ConfigError, match=f"version is 9, this release knows {VERSION}"):
        decode_stored(data)


def test_content_that_is_no_configuration_is_refused():
    with pytest.raises(ConfigError, match="no configuration"):
        decode_stored(seal(b'{"base":1}', VERSION))


@pytest.mark.parametrize("data", [b"\xff\xfe", b"[]", b"null", b"{}"])
def test_anything_else_is_refused(data):
    with pytest.raises(ConfigError, match="not whole"):
        decode_stored(data)


def test_digest_tells_specifications_apart(stations):
    left, right = stations
    assert digest_of(left) == digest_of(replace(left))
    assert digest_of(left) != digest_of(right)
    assert digest_of(left) != digest_of(replace(left, cycle_us=20_000))
    counter, *_ = left.sources
    assert digest_of(left) != digest_of(replace(left, sources=(replace(counter, step=2),)))


def test_digest_does_not_depend_on_fields_that_hold_defaults():
    class Before(msgspec.Struct, frozen=True):
        name: str
        parts: tuple[msgspec.Struct, ...] = ()

    class After(msgspec.Struct, frozen=True):
        name: str
        parts: tuple[msgspec.Struct, ...] = ()
        added: int = 0

    assert digest_of(Before("a")) == digest_of(After("a"))  # type: ignore[arg-type]
    assert digest_of(Before("a")) != digest_of(After("a", added=1))  # type: ignore[arg-type]
    nested = Before("a", (Before("b"),)), Before("a", (After("b"),))
    assert digest_of(nested[0]) == digest_of(nested[1])  # type: ignore[arg-type]
