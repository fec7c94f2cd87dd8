"""PDO objects and how a master may change them."""

from __future__ import annotations

import pytest

from devicebus.sim.devices.pdoobjects import assignment, mapping
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdState


@pytest.fixture
def dictionary():
    found = ObjectDictionary([mapping(0x1A00, [(0x6000, 1, 16)], "TxPDO"),
                              mapping(0x1A01, [(0x6000, 2, 1)], "TxPDO")])  # fmt: skip
    found.add(assignment(0x1C13, [0x1A00], found))
    return found


def write(dictionary, sub, number, size=2):
    dictionary.download(0x1C13, sub, number.to_bytes(size, "little"), OdState.PREOP)


def test_mapping_ends_on_a_whole_octet(dictionary):
    assert [e.value for e in dictionary[0x1A00].entries.values()] == [1, 0x6000_0110]
    assert [e.value for e in dictionary[0x1A01].entries.values()] == [2, 0x6000_0201, 7]


@pytest.mark.parametrize("mapped", [[(0x6000, 1, 256)], [(0x6000, 1, 8)] * 255])
def test_mapping_that_does_not_fit(mapped):
    with pytest.raises(ValueError, match="expected at most 254"):
        mapping(0x1A00, mapped, "TxPDO")


def test_assignment_is_changed_from_empty(dictionary):
    write(dictionary, 0, 0, 1)
    write(dictionary, 1, 0x1A01)
    write(dictionary, 0, 1, 1)
    assert dictionary[0x1C13].max_subindex == 1
    assert dictionary.entry(0x1C13, 1).value == 0x1A01


@pytest.mark.parametrize(
    ("steps", "code"),
    [
        ([(1, 0x1A01, 2)], AbortCode.SUBINDEX_0_NOT_ZERO),
        ([(0, 0, 1), (1, 0x1A07, 2), (0, 1, 1)], AbortCode.PARAMETER),
        ([(0, 9, 1)], AbortCode.TOO_HIGH),
    ],
)
def test_refused_changes(dictionary, steps, code):
    *well, last = steps
    for step in well:
        write(dictionary, *step)
    with pytest.raises(SdoAbortError) as caught:
        write(dictionary, *last)
    assert caught.value.code == code


def test_assignment_is_fixed_outside_preop(dictionary):
    with pytest.raises(SdoAbortError) as caught:
        dictionary.download(0x1C13, 0, b"\0", OdState.OP)
    assert caught.value.code == AbortCode.DEVICE_STATE
