from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes, pdo
from eap.pd.image import Image, Inputs
from eap.pd.spec import RxPdSpec, VariableSpec, Writer
from eap.pd.txframe import Gather
from tests.support.cyclic import Receiver, image_of, octets, station

KINDS = ["BOOL", "BIT3", "BIT7", "BIT8", "USINT", "UINT24", "LREAL", "INT[2]", "BLOCK(3)"]


def collect(image: Image, inputs: Inputs, names: list[str], offset: int = 0) -> bytes:
    gather = Gather(image, inputs, names)
    buffer = bytearray(b"\xff" * (offset + gather.size))
    gather.into(memoryview(buffer), offset)
    assert buffer[:offset] == b"\xff" * offset
    return bytes(buffer[offset:])


@given(st.data())
def test_the_data_are_the_variables_in_pdo_order(data):
    kinds = data.draw(st.lists(st.sampled_from(KINDS), min_size=1, max_size=8))
    types = [datatypes.parse(kind) for kind in kinds]
    variables = tuple(
        VariableSpec(f"v{i}", kind, data.draw(st.sampled_from(Writer)))
        for i, kind in enumerate(kinds)
    )
    image = image_of(station(variables=variables))
    values = [kind.decode(data.draw(st.binary(min_size=16, max_size=16)), 0) for kind in types]
    for variable, value in zip(variables, values, strict=True):
        image.write(variable.name, value)
    order = data.draw(st.lists(st.integers(0, len(kinds) - 1), min_size=1, max_size=10))
    whole = collect(image, Inputs(image), [f"v{i}" for i in order], data.draw(st.integers(0, 20)))
    layout = pdo.layout([types[i] for i in order])
    assert len(whole) == layout.size
    bits = int.from_bytes(whole, "little")
    end = 0
    for i, offset in zip(order, layout.bit_offsets, strict=True):
        assert not bits >> end & (1 << offset - end) - 1, "bits between variables are zero"
        end = offset + types[i].bit_length
        field = bits >> offset & (1 << types[i].bit_length) - 1
        field_octets = field.to_bytes(types[i].size, "little")
        assert field_octets == types[i].encode(values[i])
    assert not bits >> end


def test_neighbours_are_copied_in_one_piece():
    variables = tuple(VariableSpec(name, "UINT") for name in ("a", "b", "c"))
    image = image_of(station(variables=variables))
    gather = Gather(image, Inputs(image), ["a", "b", "c"])
    assert [where for where, _ in gather.copies(10)] == [slice(10, 16)]
    assert not gather.has_bits
    assert len(Gather(image, Inputs(image), ["b", "a"]).copies(0)) == 2


def test_the_engines_variables_are_live_and_all_others_are_those_of_the_cycle():
    variables = (VariableSpec("own", "UINT", Writer.ENGINE), VariableSpec("app", "UINT"))
    image = image_of(station(variables=variables))
    inputs = Inputs(image)
    image.write("own", 1)
    image.write("app", 2)
    assert collect(image, inputs, ["own", "app"]) == b"\1\0\0\0"


@pytest.mark.parametrize("bits", [0b0101, 0b1010])
def test_received_bits_are_forwarded_from_where_they_were_packed(bits):
    r = Receiver(
        RxPdSpec("r", "eap0", 1, ("a", "b", "c")),
        variables=tuple(
            VariableSpec(name, kind, Writer.ENGINE)
            for name, kind in (("a", "BOOL"), ("b", "BIT2"), ("c", "BOOL"))
        ),
    )
    r.give(octets([(1, bytes([bits]))]), 0)
    inputs = Inputs(r.image)
    assert collect(r.image, inputs, ["a", "b", "c"]) == bytes([bits])
    assert collect(r.image, inputs, ["c", "b"]) == bytes([bits >> 3 | (bits >> 1 & 3) << 1])
