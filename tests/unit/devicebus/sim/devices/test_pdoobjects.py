"""PDO objects and how a master may change them."""

from __future__ import annotations

import pytest

from devicebus.sim.devices.pdoobjects import assignment, mapping
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RO, Access, Entry, OdState, record


@pytest.fixture
def dictionary():
    readable = RO | Access.TX_MAPPABLE
    entries = {1: Entry("a", "UINT", readable), 2: Entry("b", "BOOL", readable),
               3: Entry("c", "UINT", RO), 4: Entry("d", "BLOCK(31)", readable)}  # fmt: skip
    found = ObjectDictionary([record(0x6000, "Inputs", entries)])
    found.add(mapping(0x1A00, [(0x6000, 1, 16)], found))
    found.add(mapping(0x1A01, [(0x6000, 2, 1)], found))
    found.add(assignment(0x1C13, [0x1A00], found))
    return found


def write(dictionary, sub, number, size=2, index=0x1C13):
    dictionary.download(index, sub, number.to_bytes(size, "little"), OdState.PREOP)


def test_mapping_has_what_it_is_given_and_no_padding(dictionary):
    assert [e.value for e in dictionary[0x1A00].entries.values()][:3] == [1, 0x6000_0110, 0]
    assert [e.value for e in dictionary[0x1A01].entries.values()][:3] == [1, 0x6000_0201, 0]


def test_mapping_of_part_of_an_entry_can_be_written_again(dictionary):
    dictionary.add(mapping(0x1A02, [(0x6000, 1, 12)], dictionary))
    for sub, number, size in ((0, 0, 1), (1, 0x6000_010C, 4), (0, 1, 1)):
        write(dictionary, sub, number, size, 0x1A02)
    assert dictionary.entry(0x1A02, 0).value == 1


@pytest.mark.parametrize("mapped", [[(0x6000, 1, 256)], [(0x6000, 1, 8)] * 255])
def test_mapping_that_does_not_fit(mapped):
    with pytest.raises(ValueError, match="expected at most 254"):
        mapping(0x1A00, mapped, ObjectDictionary())


@pytest.mark.parametrize("index", [0x15FF, 0x1800, 0x1C00])
def test_mapping_at_another_place(index):
    with pytest.raises(ValueError, match="is no PDO"):
        mapping(index, [], ObjectDictionary())


def test_mapping_is_changed_from_empty(dictionary):
    write(dictionary, 0, 0, 1, 0x1A01)
    for sub, number in enumerate((8, 0x6000_0110, 0x6000_0201), 1):
        write(dictionary, sub, number, 4, 0x1A01)
    write(dictionary, 0, 3, 1, 0x1A01)
    whole = dictionary.upload_complete(0x1A01, 1, OdState.PREOP)
    assert whole == bytes.fromhex("08000000 10010060 01020060")


def test_whole_mapping_in_one_transfer(dictionary):
    octets = bytes.fromhex("0100 10010060")
    dictionary.download_complete(0x1A01, 0, octets, OdState.PREOP)
    assert dictionary.upload_complete(0x1A01, 0, OdState.PREOP) == octets


@pytest.mark.parametrize(
    ("entries", "code"),
    [
        ([0x6001_0110], AbortCode.NOT_MAPPABLE),
        ([0x6000_0510], AbortCode.NOT_MAPPABLE),
        ([0x6000_0310], AbortCode.NOT_MAPPABLE),
        ([0x6000_0108], AbortCode.PARAMETER),
        ([0x6000_04F8, 16], AbortCode.PDO_LENGTH),
    ],
)
def test_mapping_that_cannot_be(dictionary, entries, code):
    write(dictionary, 0, 0, 1, 0x1A01)
    for sub, number in enumerate(entries, 1):
        write(dictionary, sub, number, 4, 0x1A01)
    with pytest.raises(SdoAbortError) as caught:
        write(dictionary, 0, len(entries), 1, 0x1A01)
    assert caught.value.code == code
    assert dictionary[0x1A01].max_subindex == 0


def test_assigned_pdos_must_fit_together(dictionary):
    dictionary.download_complete(0x1A01, 0, b"\1\0" + 0x6000_04F8.to_bytes(4, "little"),
                                 OdState.PREOP)  # fmt: skip
    with pytest.raises(SdoAbortError) as caught:
        dictionary.download_complete(0x1C13, 0, bytes.fromhex("0200 001a 011a"), OdState.PREOP)
    assert caught.value.code == AbortCode.PDO_LENGTH


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
        ([(0, 0, 1), (1, 0x6000, 2), (0, 1, 1)], AbortCode.PARAMETER),
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
