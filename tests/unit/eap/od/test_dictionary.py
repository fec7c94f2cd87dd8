"""One refusal a test, by its name in the standard; then properties of complete access."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import (
    RO,
    RW,
    RW_PREOP,
    WO,
    Entry,
    ObjectCode,
    OdObject,
    OdState,
    record,
    variable,
)

PREOP, OP = OdState.PREOP, OdState.OP


def make() -> ObjectDictionary:
    return ObjectDictionary(
        [
            record(
                0x8000,
                "Settings",
                {
                    1: Entry("Cycle", "UINT", RW_PREOP, 10, minimum=5, maximum=100),
                    2: Entry("State", "USINT", RO, 8),
                    5: Entry("Name", "STRING(8)", RW, "abc"),
                },
            ),
            variable(0x2000, "Command", "UDINT", WO),
            variable(0x1000, "Device type", "UDINT", RO, 0x1389),
            OdObject(
                0x3000, "Whole only in parts", ObjectCode.RECORD, {1: Entry("a", "UINT")},
                complete_access=False,
            ),
        ]
    )  # fmt: skip


def refusal(call: object, *arguments: object) -> int:
    with pytest.raises(SdoAbortError) as caught:
        call(*arguments)  # type: ignore[operator]
    return caught.value.code


def test_iterates_by_index() -> None:
    dictionary = make()
    assert [item.index for item in dictionary] == [0x1000, 0x2000, 0x3000, 0x8000]
    assert len(dictionary) == 4
    assert 0x8000 in dictionary
    dictionary.remove(0x8000)
    dictionary.remove(0x8000)
    assert 0x8000 not in dictionary


def test_upload_and_download() -> None:
    dictionary = make()
    dictionary.download(0x8000, 1, b"\x14\0", PREOP)
    assert dictionary.upload(0x8000, 1, OP) == b"\x14\0"
    dictionary.download(0x8000, 5, b"longer", OP)
    assert dictionary.upload(0x8000, 5, OP) == b"longer"
    assert dictionary.upload(0x8000, 0, OP) == b"\x05"


@pytest.mark.parametrize(
    ("index", "subindex", "data", "state", "code"),
    [
        (0x9999, 0, b"", PREOP, AbortCode.NO_OBJECT),
        (0x8000, 3, b"", PREOP, AbortCode.NOT_STORED),
        (0x8000, 6, b"", PREOP, AbortCode.NO_SUBINDEX),
        (0x1000, 1, b"", PREOP, AbortCode.NO_SUBINDEX),
        (0x8000, 2, b"\0", PREOP, AbortCode.READ_ONLY),
        (0x8000, 1, b"\x14\0", OP, AbortCode.DEVICE_STATE),
        (0x8000, 1, b"\x14", PREOP, AbortCode.TOO_SHORT),
        (0x8000, 1, b"\x14\0\0", PREOP, AbortCode.TOO_LONG),
        (0x8000, 5, b"123456789", PREOP, AbortCode.TOO_LONG),
        (0x8000, 1, b"\x65\0", PREOP, AbortCode.TOO_HIGH),
        (0x8000, 1, b"\x04\0", PREOP, AbortCode.TOO_LOW),
    ],
)
def test_download_is_refused(
    index: int, subindex: int, data: bytes, state: OdState, code: AbortCode
) -> None:
    dictionary = make()
    assert refusal(dictionary.download, index, subindex, data, state) == code
    assert dictionary.entry(0x8000, 1).value == 10


def test_write_only_is_not_read() -> None:
    assert refusal(make().upload, 0x2000, 0, OP) == AbortCode.WRITE_ONLY


def test_hook_refuses_and_nothing_is_stored() -> None:
    def no(data: bytes) -> None:
        raise ValueError("the valve is locked")

    dictionary = ObjectDictionary([variable(0x2000, "Valve", "BOOL", RW, write=no)])
    with pytest.raises(SdoAbortError, match="the valve is locked") as caught:
        dictionary.download(0x2000, 0, b"\x01", OP)
    assert caught.value.code == AbortCode.VALUE
    assert dictionary.upload(0x2000, 0, OP) == b"\0"


def test_complete_access_from_0_has_a_16_bit_count_and_from_1_has_none() -> None:
    whole = b"\x05\0" + b"\x0a\0" + b"\x08" + b"abc\0\0\0\0\0"
    assert make().upload_complete(0x8000, 0, OP) == whole
    assert make().upload_complete(0x8000, 1, OP) == whole[2:]


def test_complete_download_skips_read_only_entries() -> None:
    dictionary = make()
    dictionary.download_complete(0x8000, 1, b"\x20\0" + b"\xff" + b"new\0\0\0\0\0", PREOP)
    assert dictionary.entry(0x8000, 1).value == 0x20
    assert dictionary.entry(0x8000, 2).value == 8
    assert dictionary.entry(0x8000, 5).value == "new"


def test_complete_download_checks_all_before_it_stores_the_first() -> None:
    dictionary = make()
    data = b"\x01\0" + b"\xff" + b"new\0\0\0\0\0"
    assert refusal(dictionary.download_complete, 0x8000, 1, data, PREOP) == AbortCode.TOO_LOW
    assert dictionary.entry(0x8000, 5).value == "abc"


@pytest.mark.parametrize(
    ("index", "first", "data", "state", "code"),
    [
        (0x1000, 0, b"", PREOP, AbortCode.NO_COMPLETE_ACCESS),
        (0x3000, 0, b"", PREOP, AbortCode.NO_COMPLETE_ACCESS),
        (0x8000, 2, b"", PREOP, AbortCode.UNSUPPORTED_ACCESS),
        (0x8000, 1, b"123", PREOP, AbortCode.TOO_SHORT),
        (0x8000, 0, b"12345678901234", PREOP, AbortCode.TOO_LONG),
    ],
)
def test_complete_download_is_refused(
    index: int, first: int, data: bytes, state: OdState, code: AbortCode
) -> None:
    assert refusal(make().download_complete, index, first, data, state) == code


def test_complete_download_of_nothing_writable() -> None:
    locked = ObjectDictionary([record(0x4000, "a", {1: Entry("x", "UINT", RW_PREOP)})])
    assert refusal(locked.download_complete, 0x4000, 1, b"\0\0", OP) == AbortCode.DEVICE_STATE
    fixed = ObjectDictionary([record(0x4000, "a", {1: Entry("x", "UINT", RO)})])
    assert refusal(fixed.download_complete, 0x4000, 1, b"\0\0", OP) == AbortCode.READ_ONLY


def test_bits_are_packed_in_complete_access() -> None:
    dictionary = ObjectDictionary(
        [
            record(
                0x5000,
                "Bits",
                {
                    1: Entry("a", "BOOL", RW, value=True),
                    2: Entry("b", "BIT3", RW, 5),
                    3: Entry("c", "BIT7", RW, 0x55),
                    4: Entry("d", "USINT", RW, 9),
                },
            )
        ]
    )
    assert dictionary.upload_complete(0x5000, 1, OP) == bytes.fromhex("5b0509")
    dictionary.download_complete(0x5000, 1, bytes.fromhex("f40207"), OP)
    assert [e.value for e in dictionary[0x5000].entries.values()] == [4, False, 2, 0x2F, 7]


KINDS = st.sampled_from(["BOOL", "BIT3", "BIT7", "USINT", "UINT", "UDINT", "REAL", "BLOCK(5)"])


@given(st.lists(KINDS, min_size=1, max_size=12), st.randoms(use_true_random=False))
def test_complete_access_round_trips(kinds: list[str], random: object) -> None:
    def fill() -> ObjectDictionary:
        entries = {n: Entry(f"e{n}", kind, RW) for n, kind in enumerate(kinds, 1)}
        return ObjectDictionary([record(0x4000, "r", entries)])

    source, copy = fill(), fill()
    for entry in list(source[0x4000].entries.values())[1:]:
        octets = random.randbytes(entry.kind.size)  # type: ignore[attr-defined]
        mask = (1 << entry.kind.bit_length) - 1
        entry.octets = bytes((octets[0] & mask,)) if entry.kind.is_bits else octets
    copy.download_complete(0x4000, 0, source.upload_complete(0x4000, 0, OP), OP)
    for left, right in zip(
        source[0x4000].entries.values(), copy[0x4000].entries.values(), strict=True
    ):
        assert left.octets == right.octets


def assignment() -> ObjectDictionary:
    entries = {0: Entry("Count", "USINT", RW_PREOP, 1, maximum=3)}
    entries |= {sub: Entry(f"PDO {sub}", "UINT", RW_PREOP, sub) for sub in (1, 2, 3)}
    return ObjectDictionary([OdObject(0x1C12, "Assignment", ObjectCode.ARRAY, entries)])


def test_complete_download_takes_as_many_entries_as_its_count_says() -> None:
    dictionary = assignment()
    dictionary.download_complete(0x1C12, 0, bytes.fromhex("0300 0016 0116 0216"), PREOP)
    assert dictionary[0x1C12].max_subindex == 3
    dictionary.download_complete(0x1C12, 0, bytes.fromhex("0100 0716"), PREOP)
    assert dictionary.upload_complete(0x1C12, 0, PREOP) == bytes.fromhex("0100 0716")
    dictionary.download_complete(0x1C12, 0, bytes(2), PREOP)
    assert dictionary.upload_complete(0x1C12, 0, PREOP) == bytes(2)


def test_count_is_0_while_the_entries_are_written() -> None:
    dictionary = assignment()
    item = dictionary[0x1C12]
    seen = []
    item.entries[2].write = lambda data: seen.append((item.max_subindex, data))
    dictionary.download_complete(0x1C12, 0, bytes.fromhex("0200 0016 0116"), PREOP)
    assert seen == [(0, b"\x01\x16")]
    assert item.max_subindex == 2


@pytest.mark.parametrize(
    ("octets", "code"),
    [
        ("", AbortCode.TOO_SHORT),
        ("01", AbortCode.TOO_SHORT),
        ("0200 0016", AbortCode.TOO_SHORT),
        ("0100 0016 0116", AbortCode.TOO_LONG),
        ("0400 0016 0116 0216 0316", AbortCode.TOO_HIGH),
    ],
)
def test_complete_download_that_contradicts_its_count_changes_nothing(
    octets: str, code: AbortCode
) -> None:
    dictionary = assignment()
    data = bytes.fromhex(octets)
    assert refusal(dictionary.download_complete, 0x1C12, 0, data, PREOP) == code
    assert dictionary.upload_complete(0x1C12, 0, PREOP) == bytes.fromhex("0100 0100")


def test_count_above_the_entries_there_are_is_refused() -> None:
    dictionary = assignment()
    dictionary[0x1C12].entries[0].maximum = None
    code = refusal(dictionary.download_complete, 0x1C12, 0, bytes.fromhex("0400"), PREOP)
    assert code == AbortCode.NO_SUBINDEX


def test_count_is_left_alone_where_it_cannot_be_written() -> None:
    dictionary = assignment()
    data = bytes.fromhex("0300 0016 0116 0216")
    assert refusal(dictionary.download_complete, 0x1C12, 0, data, OP) == AbortCode.TOO_LONG
    data = bytes.fromhex("0100 0016")
    assert refusal(dictionary.download_complete, 0x1C12, 0, data, OP) == AbortCode.DEVICE_STATE


@pytest.mark.parametrize(
    ("index", "subindex", "size", "complete", "code"),
    [
        (0x8000, 1, 3, False, AbortCode.TOO_LONG),
        (0x8000, 1, 1, False, AbortCode.TOO_SHORT),
        (0x8000, 5, 9, False, AbortCode.TOO_LONG),
        (0x8000, 2, 1, False, AbortCode.READ_ONLY),
        (0x8000, 3, 1, False, AbortCode.NOT_STORED),
        (0x9000, 3, 1, False, AbortCode.NO_OBJECT),
        (0x8000, 0, 14, True, AbortCode.TOO_LONG),
        (0x8000, 1, 12, True, AbortCode.TOO_LONG),
        (0x3000, 0, 4, True, AbortCode.NO_COMPLETE_ACCESS),
    ],
)
def test_download_can_be_refused_before_its_data_is_there(
    index: int, subindex: int, size: int, complete: bool, code: AbortCode
) -> None:
    check = make().check_download
    with pytest.raises(SdoAbortError) as caught:
        check(index, subindex, size, PREOP, complete=complete)
    assert caught.value.code == code


def test_download_that_may_be_right_passes_the_check() -> None:
    dictionary = make()
    dictionary.check_download(0x8000, 1, 2, PREOP)
    dictionary.check_download(0x8000, 5, 3, PREOP)
    dictionary.check_download(0x8000, 0, 13, PREOP, complete=True)
    dictionary.check_download(0x8000, 1, 11, PREOP, complete=True)


def test_entry_that_may_not_be_read_is_zero_in_a_whole_object() -> None:
    entries = {1: Entry("a", "UINT", RO, 7), 2: Entry("b", "UINT", WO, 8)}
    dictionary = ObjectDictionary([record(0x9000, "Mixed", entries)])
    assert dictionary.upload_complete(0x9000, 1, OP) == bytes.fromhex("0700 0000")


def test_limits_apply_to_numbers_only() -> None:
    dictionary = ObjectDictionary([variable(0x2000, "Block", "BLOCK(2)", RW, b"ab", maximum=1)])
    dictionary.download(0x2000, 0, b"zz", OP)
    assert dictionary.upload(0x2000, 0, OP) == b"zz"
