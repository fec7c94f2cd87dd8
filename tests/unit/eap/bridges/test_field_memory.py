"""The memory that clients of a server read and write."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.bridges.field.memory import Denial, DeniedError, ServedMemory, ServedPoint
from eap.codec import datatypes
from eap.codec.fieldaddresses import modbus_point, s7_point


def served(name: str, kind: str, address: str, *, write: bool = False) -> ServedPoint:
    make = modbus_point if ":" in address else s7_point
    return ServedPoint(name, make(datatypes.parse(kind), address), write)


def block() -> ServedMemory:
    memory = ServedMemory(
        [
            served("m/on", "BOOL", "DB1.DBX0.0", write=True),
            served("m/ready", "BOOL", "DB1.DBX0.1"),
            served("m/speed", "REAL", "DB1.DBD2"),
            served("m/setpoint", "REAL", "DB1.DBD8", write=True),
            served("m/name", "STRING(4)", "DB1.DBB12", write=True),
        ]
    )
    values = {"m/on": False, "m/ready": True, "m/speed": 1.0, "m/setpoint": 2.0, "m/name": "ab"}
    for name, value in values.items():
        assert memory.update(name, value) == ""
    return memory


def write(memory: ServedMemory, first: int, data: str) -> dict[str, Any]:
    octets = bytes.fromhex(data)
    return memory.changes("DB1", 8 * first, 8 * len(octets), octets)


def test_block_is_read_as_a_whole_and_in_parts() -> None:
    memory = block()
    whole = memory.read("DB1", 0, 8 * 18)
    assert whole.hex() == "0200" + "3f800000" + "0000" + "40000000" + "0402" + "61620000"
    assert memory.read("DB1", 16, 32) == whole[2:6]
    assert memory.read("DB1", 1, 1) == b"\1"


def test_write_gives_values_in_plain_form() -> None:
    memory = block()
    assert write(memory, 8, "40400000") == {"m/setpoint": 3.0}
    assert memory.changes("DB1", 0, 1, b"\1") == {"m/on": True}
    assert write(memory, 12, "0403787978") == {"m/name": "xyx"}


def test_whole_block_may_be_written_back() -> None:
    memory = block()
    whole = bytearray(memory.read("DB1", 0, 8 * 18))
    whole[0] |= 1
    assert write(memory, 0, whole.hex()) == {"m/on": True, "m/setpoint": 2.0, "m/name": "ab"}


def test_part_of_a_value_leaves_its_other_bytes() -> None:
    assert write(block(), 9, "80") == {"m/setpoint": 4.0}


@pytest.mark.parametrize(
    ("first", "data", "denial"),
    [
        (2, "40400000", Denial.READ_ONLY),
        (2, "3f800000", Denial.READ_ONLY),
        (0, "01", Denial.READ_ONLY),
        (6, "0001", Denial.ADDRESS),
        (0, "06", Denial.ADDRESS),
        (17, "0000", Denial.ADDRESS),
        (2, "40400000" + "0000" + "40400000", Denial.READ_ONLY),
    ],
    ids=["read only", "same value", "read-only bit", "gap", "unused bit", "end", "both"],
)
def test_write_that_would_lose_something_is_refused(first: int, data: str, denial: Denial) -> None:
    memory = block()
    before = memory.read("DB1", 0, 8 * 18)
    with pytest.raises(DeniedError) as caught:
        write(memory, first, data)
    assert caught.value.denial is denial
    assert memory.read("DB1", 0, 8 * 18) == before


def test_value_that_the_variable_cannot_hold_is_refused() -> None:
    memory = ServedMemory([served("m/level", "INT (0..9)", "DB1.DBW0", write=True)])
    with pytest.raises(DeniedError) as caught:
        write(memory, 0, "000a")
    assert caught.value.denial is Denial.VALUE


def test_variable_without_a_value_is_no_zero() -> None:
    memory = ServedMemory([served("m/a", "INT", "DB1.DBW0"), served("m/b", "INT", "DB1.DBW2")])
    memory.update("m/a", 1)
    assert memory.read("DB1", 0, 16) == b"\0\1"
    with pytest.raises(DeniedError) as caught:
        memory.read("DB1", 0, 32)
    assert caught.value.denial is Denial.NO_VALUE
    assert "m/b" in str(caught.value)


def test_value_that_does_not_fit_its_address_keeps_the_one_before() -> None:
    memory = ServedMemory(
        [ServedPoint("m/a", s7_point(datatypes.parse("REAL"), "DB1.0", "INT"), write=False)]
    )
    assert memory.update("m/a", 7.2) == ""
    assert "out of range" in memory.update("m/a", 1e6)
    assert memory.read("DB1", 0, 16) == b"\0\7"


def test_number_that_json_cannot_carry_is_shown_as_nan_and_not_written() -> None:
    memory = block()
    assert memory.update("m/speed", None) == ""  # as the control protocol shows NaN and infinities
    assert memory.update("m/setpoint", None) == ""
    assert memory.read("DB1", 16, 32).hex() == "7fc00000"
    # A panel that writes the whole block back leaves it.
    assert write(memory, 0, memory.read("DB1", 0, 8 * 18).hex()) == {"m/on": False, "m/name": "ab"}
    for number in ("7fc00001", "7f800000"):
        with pytest.raises(DeniedError, match="m/setpoint: clients write neither NaN") as caught:
            write(memory, 8, number)
        assert caught.value.denial is Denial.VALUE


def test_coils_and_bits_of_registers() -> None:
    memory = ServedMemory(
        [
            served("m/a", "BOOL", "coil:0", write=True),
            served("m/b", "BOOL", "coil:9", write=True),
            served("m/c", "BOOL", "holding:0.0", write=True),
            served("m/d", "BOOL", "holding:0.15", write=True),
        ]
    )
    for name in ("m/a", "m/b", "m/c", "m/d"):
        memory.update(name, True)
    assert memory.read("coil", 0, 10).hex() == "0102"
    assert memory.read("coil", 5, 5).hex() == "10"
    assert memory.read("holding", 0, 16).hex() == "8001"
    assert memory.changes("coil", 9, 1, b"\0") == {"m/b": False}
    assert memory.changes("holding", 0, 16, b"\x80\0") == {"m/c": False, "m/d": True}


@given(st.integers(0, 160), st.integers(0, 200), st.binary(max_size=24))
def test_any_write_is_done_or_denied(start: int, bits: int, data: bytes) -> None:
    memory = block()
    try:
        changes = memory.changes("DB1", start, bits, data)
    except DeniedError:
        return
    assert set(changes) <= {"m/on", "m/setpoint", "m/name"}
