"""Messages of values: golden bytes, a foreign decoder, every type there and back."""

from __future__ import annotations

import random
from typing import Any

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes
from eap.errors import MalformedError
from eap.pd.image import extract_value
from eap.pd.layout import VariableSlot
from eap.pd.spec import Writer
from eap.recording.messages import (
    PlacedVariable,
    RecordedVariable,
    StationMessages,
    field_names,
    pack_closely,
)
from tests.support.stations import TYPES

MORE_TYPES = (
    *TYPES,
    "DINT", "USINT", "INT", "UINT40", "UDINT[3]", "INT[2,1..3]", "DATE", "WCHAR", "STRING(4)[2]",
    "E<INT:Off=0,On=1>",
    "U<4/4:w@0 UDINT,b@0 USINT[4]>",
    "A<12/4:pos@0 DINT,on@4 BOOL,name@5 STRING(3),v@8 REAL>[2]",
)  # fmt: skip


def messages_of(*types: str) -> tuple[StationMessages, list[PlacedVariable], int]:
    placed = pack_closely(RecordedVariable(f"v{n}", text) for n, text in enumerate(types))
    return StationMessages("st", placed), placed, sum(datatypes.parse(t).size for t in types)


def values(placed: list[PlacedVariable], sample: bytes) -> list[Any]:
    slots = [VariableSlot(v.name, v.type, Writer.ENGINE, bit) for v, bit in placed]
    return [datatypes.parse(slot.type).decode(extract_value(slot, sample, 0), 0) for slot in slots]


def foreign(messages: StationMessages, message: bytes) -> Any:
    """Return what protobuf's own library reads."""
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(messages.descriptor()).file:
        pool.AddSerializedFile(file.SerializeToString())
    return GetMessageClass(pool.FindMessageTypeByName(messages.schema_name)).FromString(message)


def test_message_has_the_bytes_of_the_protobuf_encoding() -> None:
    messages, _, _ = messages_of("INT", "BOOL", "REAL", "STRING(4)")
    sample = bytes.fromhex("feff 01 0000803f 61620000")
    assert messages.pack(258, sample) == bytes.fromhex(
        "09 0201000000000000"  # field 1, fixed64
        "15 feffffff"  # field 2, sfixed32: -2
        "18 01"  # field 3, varint: true
        "25 0000803f"  # field 4, float: 1.0
        "2a 02 6162"  # field 5, two bytes of text
    )


@given(st.data())
def test_message_of_all_types_gives_the_same_values_again(data: st.DataObject) -> None:
    chosen = data.draw(st.lists(st.sampled_from(MORE_TYPES), min_size=1, max_size=8))
    messages, placed, size = messages_of(*chosen)
    sample = random.Random(data.draw(st.integers(0, 1 << 30))).randbytes(size)
    cycle, found = messages.unpack(messages.pack(7, sample))
    again = values(placed, messages.sample(found, size))
    expected = values(placed, sample)
    # Bytes that are no text read as U+FFFD, which takes three: then the text may be cut.
    if "\ufffd" not in repr(expected):
        assert repr(again) == repr(expected)
    assert cycle == 7
    assert len(found) == len(messages.leaves)


def test_message_keeps_every_bit_of_a_signalling_nan() -> None:
    messages, _, size = messages_of("REAL", "REAL[2]", "LREAL")
    sample = bytes.fromhex("010080ff 0100a07f 0100807f 010000000000f07f")
    assert messages.pack(1, sample).endswith(sample[12:])
    assert bytes.fromhex("010080ff") in messages.pack(1, sample)
    assert size == len(sample)


def test_foreign_decoder_reads_named_fields() -> None:
    messages, placed, size = messages_of(
        "INT[2]", "BOOL", "A<12/4:pos@0 DINT,on@4 BOOL,name@5 STRING(3),v@8 REAL>[2]", "LINT"
    )
    sample = bytearray(size)
    for (variable, bit), value in zip(
        placed,
        (
            (-1, 2),
            True,
            [{"pos": -5, "on": 1, "name": "äb", "v": 0.5}, {"pos": 9, "on": 0, "name": "", "v": 2}],
            -(1 << 60),
        ),
        strict=True,
    ):
        datatypes.parse(variable.type).write(sample, bit // 8, value)
    read = foreign(messages, messages.pack(1 << 40, bytes(sample)))
    assert read.cycle_number == 1 << 40
    assert list(read.v0) == [-1, 2]
    assert read.v1
    assert [(a.pos, a.on, a.name, a.v) for a in read.v2] == [
        (-5, True, "äb", 0.5),
        (9, False, "", 2),
    ]
    assert read.v3 == -(1 << 60)


def test_bits_that_share_bytes_are_read_one_by_one() -> None:
    placed = [
        PlacedVariable(RecordedVariable("a", "BIT3"), 1),
        PlacedVariable(RecordedVariable("b", "BIT8"), 4),
        PlacedVariable(RecordedVariable("c", "BOOL"), 12),
    ]
    messages = StationMessages("st", placed)
    _, found = messages.unpack(messages.pack(0, bytes.fromhex("5a1b")))
    assert found == [0b101, 0xB5, True]
    assert messages.sample(found, 2) == bytes.fromhex("5a1b")


def test_leaves_have_the_paths_of_members_and_elements() -> None:
    messages, _, _ = messages_of("INT[2,1..2]", "P<4/2:x@0 INT,y@2 INT>[2]")
    assert [leaf.path for leaf in messages.leaves] == [
        "v0[0,1]", "v0[0,2]", "v0[1,1]", "v0[1,2]", "v1[0].x", "v1[0].y", "v1[1].x", "v1[1].y",
    ]  # fmt: skip


def test_field_names_are_identifiers_and_differ() -> None:
    assert field_names(["a.b", "a_b", "1x", "cycle_number"], ["cycle_number"]) == [
        "a_b",
        "a_b_2",
        "_1x",
        "cycle_number_2",
    ]


def test_fields_leave_out_the_numbers_that_protobuf_reserves() -> None:
    messages, _, _ = messages_of(*["USINT"] * 19_005)
    (file,) = FileDescriptorSet.FromString(messages.descriptor()).file
    numbers = [field.number for field in file.message_type[0].field]
    assert numbers == [*range(1, 19_000), *range(20_000, 20_007)]


@pytest.mark.parametrize("cut", [1, 8, 9, 14, 20])
def test_message_of_another_length_is_malformed(cut: int) -> None:
    messages, _, size = messages_of("UDINT", "STRING(8)")
    message = messages.pack(0, b"\1\2\3\4abcdefgh")
    assert size == 12
    with pytest.raises(MalformedError):
        messages.unpack(message[:cut])
    with pytest.raises(MalformedError):
        messages.unpack(message + b"x")
