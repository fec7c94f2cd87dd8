"""Records of the control protocol between neighbouring releases, with copies of older ones."""

from __future__ import annotations

from dataclasses import MISSING
from typing import Any

import msgspec
import pytest

from eap.control.protocol import HELLO, Document, Hello
from eap.ids import NetId, decode_value, encode_value
from eap.pd.spec import StationSpec
from eap.runtime.store import lean

STATION = StationSpec(name="oven", net_id=NetId.parse("1.2.3.4.1.1"), cycle_us=10_000, ports=())


class OldHello(Document, frozen=True, kw_only=True):
    """Answer to ``hello`` before it had a host, a file and methods by ADS."""

    version: int
    release: str = ""
    plant: str
    pid: int = 0
    stations: list[str]


def old_station_without(name: str) -> type[msgspec.Struct]:
    """Return the record of a release before the field *name* was added."""
    rows: list[Any] = []
    for field in msgspec.structs.fields(StationSpec):
        if field.name == name:
            continue
        if field.default is not msgspec.NODEFAULT:
            rows.append((field.name, field.type, field.default))
        elif field.default_factory is not msgspec.NODEFAULT:
            factory = field.default_factory
            rows.append((field.name, field.type, msgspec.field(default_factory=factory)))
        else:
            rows.append((field.name, field.type))
    return msgspec.defstruct("OldStation", rows, forbid_unknown_fields=True)


def test_old_client_reads_the_answer_of_a_new_appliance() -> None:
    new = Hello(version=1, release="9", plant="p", stations=["a"], host="h", by_ads=["plan"])
    found = msgspec.convert(msgspec.to_builtins(new), OldHello)
    assert (found.release, found.plant, found.stations) == ("9", "p", ["a"])


def test_new_client_reads_the_answer_of_an_old_appliance() -> None:
    old = OldHello(version=1, release="0", plant="p", stations=["a"])
    found = HELLO.decode(msgspec.to_builtins(old))
    assert (found.release, found.host, found.by_ads) == ("0", "", [])


def test_old_appliance_takes_a_specification_that_does_not_use_a_new_field() -> None:
    sent = msgspec.to_builtins(lean(STATION), enc_hook=encode_value)
    assert "links" not in sent
    found = msgspec.convert(sent, old_station_without("links"), dec_hook=decode_value)
    assert getattr(found, "name", MISSING) == "oven"


def test_old_appliance_refuses_a_specification_with_a_new_field_by_its_name() -> None:
    used = msgspec.structs.replace(STATION, phase_us=500)
    sent = msgspec.to_builtins(lean(used), enc_hook=encode_value)
    with pytest.raises(msgspec.ValidationError, match="unknown field `phase_us`"):
        msgspec.convert(sent, old_station_without("phase_us"), dec_hook=decode_value)
