"""FMMUs against a model that copies one bit at a time."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from devicebus.sim.fmmu import active_windows, find_slices, insert_slices, read_slices, write_slices
from devicebus.wire.register import Fmmu


class Memory:
    """256 bytes that anybody may touch, but for those from 128 on."""

    def __init__(self, content=bytes(256)):
        self.octets = bytearray(content)

    def read(self, address, length, now_ns):
        return None if address >= 128 else self.peek(address, length)

    def write(self, address, data, now_ns):
        if address < 128:
            self.octets[address : address + len(data)] = data
        return address < 128

    def peek(self, address, length):
        return bytes(self.octets[address : address + length])


def windows(*units: Fmmu):
    memory = bytearray(0x1000)
    for number, unit in enumerate(units):
        memory[0x600 + 16 * number : 0x610 + 16 * number] = unit.encode()
    return active_windows(memory, len(units))


def unit(logical, length, physical, kind=3, *, bits=(0, 7, 0)):
    return Fmmu(logical, length, bits[0], bits[1], physical, bits[2], kind, 1)


def read(memory, units, address, size):
    chosen = [each for each in units if each.can_read]
    return read_slices(memory, find_slices(chosen, address, size), 0)


def write(memory, units, address, data):
    chosen = [each for each in units if each.can_write]
    pieces = find_slices(chosen, address, len(data))
    return write_slices(memory, pieces, bytearray(b"?" + data), 1, 0)


def insert(data, found):
    frame = bytearray(b"??") + data
    insert_slices(frame, 2, found)
    data[:] = frame[2:]


def test_fmmu_windows_are_active_with_a_length():
    off = Fmmu(0, 4, type=1, activate=0)
    assert windows(off, unit(0, 0, 0), unit(8, 2, 3)) == windows(unit(8, 2, 3))
    assert windows(unit(0, 1, 0, bits=(5, 3, 0))) == ()


def test_fmmu_reads_overlapping_bytes():
    memory = Memory(bytes(range(256)))
    parts = read(memory, windows(unit(100, 4, 10)), 98, 4)
    data = bytearray(b"\xee" * 4)
    insert(data, parts)
    assert data == b"\xee\xee\x0a\x0b"
    assert read(memory, windows(unit(100, 4, 10)), 104, 8) == []


def test_direction_and_refusal():
    memory = Memory()
    assert read(memory, windows(unit(0, 2, 0, kind=2)), 0, 2) == []
    assert not write(memory, windows(unit(0, 2, 0, kind=1)), 0, b"ab")
    assert read(memory, windows(unit(0, 2, 200)), 0, 2) == []
    assert not write(memory, windows(unit(0, 2, 200)), 0, b"ab")


def test_fmmu_bits_keep_their_neighbours():
    memory = Memory(b"\xff" * 256)
    one_bit = windows(unit(0, 1, 5, bits=(3, 3, 6)))
    assert write(memory, one_bit, 0, b"\x00")
    assert memory.octets[5] == 0b1011_1111
    data = bytearray(b"\xff")
    insert(data, read(memory, one_bit, 0, 1))
    assert data == b"\xf7"


@st.composite
def one_unit(draw):
    first = draw(st.integers(0, 7))
    length = draw(st.integers(1, 4))
    last = draw(st.integers(first if length == 1 else 0, 7))
    physical_bit = draw(st.integers(0, 7))
    return unit(draw(st.integers(0, 12)), length, draw(st.integers(0, 20)),
                bits=(first, last, physical_bit))  # fmt: skip


def mapped_bits(each: Fmmu):
    count = 8 * (each.length - 1) + each.logical_end_bit - each.logical_start_bit + 1
    for n in range(count):
        yield (8 * each.logical_start + each.logical_start_bit + n,
               8 * each.physical_start + each.physical_start_bit + n)  # fmt: skip


@given(one_unit(), st.binary(min_size=8, max_size=8), st.binary(min_size=32, max_size=32))
def test_fmmu_equals_a_bitwise_model(each, sent, content):
    address = 4
    expected_data = int.from_bytes(sent, "little")
    expected_memory = int.from_bytes(content, "little")
    before = expected_memory
    for logical, physical in mapped_bits(each):
        place = logical - 8 * address
        if 0 <= place < 64:
            expected_memory &= ~(1 << physical)
            expected_memory |= (expected_data >> place & 1) << physical
    for logical, physical in mapped_bits(each):
        place = logical - 8 * address
        if 0 <= place < 64:
            expected_data &= ~(1 << place)
            expected_data |= (before >> physical & 1) << place
    memory = Memory(content + bytes(224))
    data = bytearray(sent)
    parts = read(memory, windows(each), address, 8)
    write(memory, windows(each), address, sent)
    insert(data, parts)
    assert int.from_bytes(data, "little") == expected_data
    assert int.from_bytes(memory.octets[:32], "little") == expected_memory
