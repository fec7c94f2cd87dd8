from __future__ import annotations

import struct

import pytest

from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.info import entry_description, object_description, object_list
from eap.od.model import RO, RW, Access, Entry, record, variable

DICTIONARY = ObjectDictionary(
    [
        variable(0x1000, "Device type", "UDINT", RO, 5001),
        record(
            0x6000,
            "Inputs",
            {
                1: Entry(
                    "Level", "INT", RO | Access.TX_MAPPABLE, -3, unit=7, minimum=-10, maximum=10
                )
            },
        ),
        record(0x7000, "Outputs", {1: Entry("Valve", "BOOL", RW | Access.RX_MAPPABLE)}),
        variable(0x8000, "Setting", "UINT", RW | Access.BACKUP | Access.SETTINGS),
    ]
)


@pytest.mark.parametrize(
    ("kind", "indexes"),
    [
        (1, [0x1000, 0x6000, 0x7000, 0x8000]),
        (2, [0x7000]),
        (3, [0x6000]),
        (4, [0x8000]),
        (5, [0x8000]),
    ],
)
def test_lists(kind: int, indexes: list[int]) -> None:
    assert object_list(DICTIONARY, kind) == struct.pack(f"<{1 + len(indexes)}H", kind, *indexes)


def test_list_0_counts_the_five_lists() -> None:
    assert object_list(DICTIONARY, 0) == struct.pack("<6H", 0, 4, 1, 1, 1, 1)


def test_unknown_list() -> None:
    with pytest.raises(SdoAbortError, match="object list type 6") as caught:
        object_list(DICTIONARY, 6)
    assert caught.value.code == AbortCode.PARAMETER


def test_object_description() -> None:
    expected = bytes.fromhex("0060 0300 01 09") + b"Inputs"
    assert object_description(DICTIONARY, 0x6000) == expected


def test_entry_description_holds_the_requested_parts() -> None:
    head = bytes.fromhex("0060 01")
    fixed = bytes.fromhex("0300 1000 8700")
    assert entry_description(DICTIONARY, 0x6000, 1, 0) == head + b"\0" + fixed + b"Level"
    everything = bytes.fromhex("07000000 fdff f6ff 0a00")
    assert (
        entry_description(DICTIONARY, 0x6000, 1, 0x7F)
        == head + b"\x7f" + fixed + everything + b"Level"
    )


def test_entry_description_omits_missing_parts() -> None:
    description = entry_description(DICTIONARY, 0x7000, 1, 0x7F)
    assert description[3] == 0x17  # no unit, no limits
    assert description.endswith(b"\0Valve")


def test_missing_entry() -> None:
    with pytest.raises(SdoAbortError):
        entry_description(DICTIONARY, 0x6000, 9, 0)
