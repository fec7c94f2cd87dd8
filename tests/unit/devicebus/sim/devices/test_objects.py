"""Dictionaries made from descriptions."""

from __future__ import annotations

import pytest

from devicebus.sim.devices.objects import (
    PdoRules,
    assignment,
    build_dictionary,
    mapping,
    object_ids_of,
)
from devicebus.sim.spec import AccessKind, ChannelSpec, EntrySpec, ObjectSpec
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RO, Access, Entry, OdState, record
from tests.support.bus import generic


@pytest.fixture
def dictionary():
    readable = RO | Access.TX_MAPPABLE
    entries = {1: Entry("a", "UINT", readable), 2: Entry("b", "BOOL", readable),
               3: Entry("c", "UINT", RO), 4: Entry("d", "BLOCK(31)", readable)}  # fmt: skip
    found = ObjectDictionary([record(0x6000, "Inputs", entries)])
    found.add(mapping(0x1A00, [(0x6000, 1, 16)], found, is_output=False))
    found.add(mapping(0x1A01, [(0x6000, 2, 1)], found, is_output=False))
    found.add(assignment(0x1C13, [0x1A00], found, PdoRules(range(0x1A00, 0x1C00)), is_output=False))
    return found


def write(dictionary, sub, number, size=2, index=0x1C13):
    dictionary.download(index, sub, number.to_bytes(size, "little"), OdState.PREOP)


def test_pdo_mapping_has_the_given_entries_without_padding(dictionary):
    assert [e.value for e in dictionary[0x1A00].entries.values()][:3] == [1, 0x6000_0110, 0]
    assert [e.value for e in dictionary[0x1A01].entries.values()][:3] == [1, 0x6000_0201, 0]


def test_mapping_of_part_of_an_entry_can_be_written_again(dictionary):
    dictionary.add(mapping(0x1A02, [(0x6000, 1, 12)], dictionary, is_output=False))
    for sub, number, size in ((0, 0, 1), (1, 0x6000_010C, 4), (0, 1, 1)):
        write(dictionary, sub, number, size, 0x1A02)
    assert dictionary.entry(0x1A02, 0).value == 1


@pytest.mark.parametrize("mapped", [[(0x6000, 1, 256)], [(0x6000, 1, 8)] * 255])
def test_mapping_that_does_not_fit(mapped):
    with pytest.raises(ValueError, match="expected at most 254"):
        mapping(0x1A00, mapped, ObjectDictionary(), is_output=False)


def test_mapping_is_changed_from_empty(dictionary):
    write(dictionary, 0, 0, 1, 0x1A01)
    for sub, number in enumerate((8, 0x6000_0110, 0x6000_0201), 1):
        write(dictionary, sub, number, 4, 0x1A01)
    write(dictionary, 0, 3, 1, 0x1A01)
    whole = dictionary.upload_complete(0x1A01, 1, OdState.PREOP)
    assert whole == bytes.fromhex("08000000 10010060 01020060")


def test_pdo_mapping_by_complete_access(dictionary):
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
def test_object_refuses_change_with_its_abort_code(dictionary, steps, code):
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


def test_channels_without_an_entry_count_up():
    channels = [
        ChannelSpec(name="a"),
        ChannelSpec(name="b", object="0x6041"),
        ChannelSpec(name="c"),
    ]
    assert object_ids_of(channels, 0x6000) == [(0x6000, 1), (0x6041, 0), (0x6000, 2)]
    many = object_ids_of([ChannelSpec(name=str(n)) for n in range(201)], 0x7000)
    assert many[199:] == [(0x7000, 200), (0x7010, 1)]


def test_identity_and_names():
    dictionary = build_dictionary(generic("pump", vendor=7, product=8, revision=9, serial=10), 5001)
    assert [dictionary.entry(0x1018, sub).value for sub in range(5)] == [4, 7, 8, 9, 10]
    assert dictionary.upload(0x1008, 0, OdState.PREOP) == b"pump"
    assert dictionary.entry(0x1000, 0).value == 5001


def test_pdos_map_the_channels():
    dictionary = build_dictionary(generic(), 5001)
    assert dictionary[0x1A00].max_subindex == 2
    assert [dictionary.entry(0x1A00, sub).value for sub in (1, 2)] == [0x6000_0110, 0x6000_0201]
    assert dictionary[0x6000].name == "Inputs"
    assert dictionary[0x7000].entries[2].name == "valve"
    assert dictionary.entry(0x1C12, 1).value == 0x1600


def test_channels_in_several_pdos_with_padding():
    inputs = (
        ChannelSpec(name="a", pdo=0x1A03),
        ChannelSpec(name="gap", type="BIT7", object="0", pdo=0x1A03),
        ChannelSpec(name="b", type="UINT", pdo=0x1A01),
        ChannelSpec(name="c", pdo=0x1A05, assigned=False),
    )
    dictionary = build_dictionary(generic(inputs=inputs), 5001)
    assert [dictionary.entry(0x1A03, sub).value for sub in (0, 1, 2)] == [2, 0x6000_0101, 7]
    assert [dictionary.entry(0x1C13, sub).value for sub in (0, 1, 2)] == [2, 0x1A03, 0x1A01]
    assert dictionary.entry(0x1A05, 1).value == 0x6000_0301


@pytest.mark.parametrize("pdo", [0x1600, 0x1C00, 5])
def test_pdo_of_the_other_direction(pdo):
    with pytest.raises(ValueError, match="no PDO of its direction"):
        build_dictionary(generic(inputs=(ChannelSpec(name="a", pdo=pdo),)), 5001)


def test_device_without_outputs_assigns_nothing():
    dictionary = build_dictionary(generic(outputs=()), 5001)
    assert 0x1600 not in dictionary
    assert dictionary.entry(0x1C12, 0).value == 0


def test_objects_with_limits_and_rights():
    spec = generic(
        objects=(
            ObjectSpec(index=0x8000, name="settings", entries=(
                EntrySpec(subindex=1, name="gain", type="UDINT", maximum=10),
                EntrySpec(subindex=3, name="key", type="UINT", access=AccessKind.WRITE),
            )),
            ObjectSpec(index=0x8001, name="text", type="STRING(8)", value="abc"),
        )
    )  # fmt: skip
    dictionary = build_dictionary(spec, 5001)
    assert dictionary.upload(0x8001, 0, OdState.OP) == b"abc"
    for index, sub, data, code in (
        (0x8000, 1, b"\x0b\0\0\0", AbortCode.TOO_HIGH),
        (0x8000, 2, b"", AbortCode.NOT_STORED),
    ):
        with pytest.raises(SdoAbortError) as caught:
            dictionary.download(index, sub, data, OdState.PREOP)
        assert caught.value.code == code
    with pytest.raises(SdoAbortError):
        dictionary.upload(0x8000, 3, OdState.PREOP)


def test_channel_may_use_an_object_that_is_there():
    spec = generic(
        inputs=(ChannelSpec(name="status", type="UINT", object="0x6041:0"),),
        objects=(ObjectSpec(index=0x6041, name="Statusword", type="UINT", value=5),),
    )
    dictionary = build_dictionary(spec, 402)
    assert (dictionary[0x6041].name, dictionary.entry(0x6041, 0).value) == ("Statusword", 5)
    assert dictionary.entry(0x1A00, 1).value == 0x6041_0010


def test_channel_may_be_an_object_of_its_own():
    spec = generic(outputs=(ChannelSpec(name="target", type="DINT", object="0x607A:0", value=-3),))
    dictionary = build_dictionary(spec, 402)
    assert dictionary.entry(0x607A, 0).value == -3


def test_type_that_does_not_exist():
    with pytest.raises(ValueError, match="UNIT"):
        build_dictionary(generic(inputs=(ChannelSpec(name="x", type="UNIT"),)), 0)
