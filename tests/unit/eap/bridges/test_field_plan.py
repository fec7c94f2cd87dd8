"""Plans of reads: few spans, within the limits of a protocol, and retreat from refused ones."""

from hypothesis import given
from hypothesis import strategies as st

from eap.bridges.field.plan import (
    PointKey,
    ReadPlan,
    ReadSpan,
    SpanLimits,
    batches,
    bytes_in,
    pieces,
)
from eap.codec import datatypes
from eap.codec.fieldaddresses import FieldPoint, modbus_point, s7_point, unit_bits

LIMITS = SpanLimits(lambda _: 8 * 200, lambda _: 8 * 16)
KINDS = ["BOOL", "BYTE", "INT", "REAL", "LREAL", "STRING(9)"]


def points(*addresses: tuple[str, str]) -> dict[PointKey, FieldPoint]:
    return {
        PointKey("one", address): s7_point(datatypes.parse(kind), address)
        for kind, address in addresses
    }


def shown(plan: ReadPlan) -> list[tuple[str, int, int, int]]:
    return [(s.area, s.start // 8, s.bits // 8, len(s.keys)) for s in plan.spans]


def test_neighbours_are_read_together_and_distant_values_apart() -> None:
    plan = ReadPlan(
        points(
            ("REAL", "DB1.DBD4"), ("BOOL", "DB1.DBX0.3"), ("BOOL", "DB1.DBX0.4"),
            ("INT", "DB1.DBW40"), ("INT", "DB2.DBW8"), ("INT", "MW8"),
        ),
        LIMITS,
    )  # fmt: skip
    assert shown(plan) == [("DB1", 0, 8, 3), ("DB1", 40, 2, 1), ("DB2", 8, 2, 1), ("M", 8, 2, 1)]


def test_values_of_a_refused_span_are_read_alone() -> None:
    plan = ReadPlan(points(("INT", "DB1.DBW0"), ("INT", "DB1.DBW2"), ("INT", "DB2.DBW0")), LIMITS)
    assert plan.split(plan.spans[0])
    assert shown(plan) == [("DB1", 0, 2, 1), ("DB1", 2, 2, 1), ("DB2", 0, 2, 1)]
    assert not plan.split(plan.spans[0])


def test_overlapping_values_share_a_span() -> None:
    plan = ReadPlan(points(("LREAL", "DB1.DBB0"), ("BYTE", "DB1.DBB3")), LIMITS)
    assert shown(plan) == [("DB1", 0, 8, 2)]


@given(
    st.lists(st.tuples(st.sampled_from(KINDS), st.integers(1, 3), st.integers(0, 600)), max_size=60)
)
def test_every_value_lies_in_its_span(found: list[tuple[str, int, int]]) -> None:
    wanted = {
        PointKey("one", f"{number}"): s7_point(
            datatypes.parse(kind), f"DB{block}.{at}" + (".1" if kind == "BOOL" else "")
        )
        for number, (kind, block, at) in enumerate(found)
    }
    plan = ReadPlan(wanted, LIMITS)
    assert sorted(key for span in plan.spans for key in span.keys) == sorted(wanted)
    memory = bytes(range(251)) * 4
    for span in plan.spans:
        assert span.bits <= LIMITS.most_bits(span.area)
        assert not span.start % unit_bits(span.area)
        data = memory[span.start // 8 : (span.start + span.bits) // 8]
        for key in span.keys:
            start, size = wanted[key].place.bit, wanted[key].type.size
            if wanted[key].type.bits > 1:
                assert bytes_in(span, data, wanted[key]) == memory[start // 8 : start // 8 + size]


def test_coils_are_read_by_bits() -> None:
    point = modbus_point(datatypes.parse("BOOL"), "coil:13")
    key = PointKey("one", "a")
    plan = ReadPlan({key: point}, LIMITS)
    assert plan.spans == (ReadSpan("coil", 13, 1, (key,)),)


def test_requests_are_filled_and_long_values_divided() -> None:
    spans = [ReadSpan("DB1", 800 * n, 80, ()) for n in range(5)]
    assert [len(each) for each in batches(spans, lambda some: len(some) <= 2)] == [2, 2, 1]
    parts = pieces(ReadSpan("DB1", 16, 80, ()), 32)
    assert [(each.start, each.bits) for each in parts] == [(16, 32), (48, 32), (80, 16)]
