from __future__ import annotations

import msgspec
import pytest

from eap.pd import pieces
from eap.pd.layout import ImageLayout, plan_layout
from eap.pd.spec import RxPdSpec, StationSpec, VariableSpec, Writer
from tests.support.cyclic import PEER, station


def spec(count: int) -> StationSpec:
    return station(
        variables=tuple(VariableSpec(f"v{n}", "INT", Writer.ENGINE) for n in range(count)),
        subscriptions=tuple(
            RxPdSpec(f"p{n}", "eap0", n, (f"v{n}",), PEER, version=n) for n in range(count)
        ),
    )


@pytest.mark.parametrize("count", [0, 1, pieces.PIECE, pieces.PIECE + 1, 3 * pieces.PIECE - 1])
def test_both_ways(count):
    given = spec(count)
    assert pieces.from_lines(pieces.to_lines(given), StationSpec) == given
    layout = plan_layout(given)
    assert msgspec.json.decode(pieces.encode(layout), type=ImageLayout) == layout
    assert pieces.encode(layout) == msgspec.json.encode(layout)


def test_no_line_is_long():
    lines = pieces.to_lines(spec(10 * pieces.PIECE)).split(b"\n")
    assert len(lines) == 1 + 1 + 20  # the rest, one port, ten times variables and subscriptions
    assert max(map(len, lines)) < 300 * pieces.PIECE


@pytest.mark.parametrize("octets", [b"", b"{}", b'{"name":1}', b"\xff"])
def test_anything_else_is_no_record(octets):
    with pytest.raises((msgspec.MsgspecError, UnicodeDecodeError)):
        pieces.from_lines(octets, StationSpec)


def test_a_line_of_no_field_is_told():
    with pytest.raises(KeyError, match="wheels"):
        pieces.from_lines(pieces.to_lines(spec(1)) + b"\nwheels []", StationSpec)
