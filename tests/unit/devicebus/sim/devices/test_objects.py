"""Dictionaries made from descriptions."""

from __future__ import annotations

import pytest

from devicebus.sim.devices.objects import build_dictionary, places
from devicebus.sim.spec import AccessKind, ChannelSpec, EntrySpec, ObjectSpec
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.model import OdState
from tests.support.bus import generic


def test_channels_without_an_entry_count_up():
    channels = [
        ChannelSpec(name="a"),
        ChannelSpec(name="b", object="0x6041"),
        ChannelSpec(name="c"),
    ]
    assert places(channels, 0x6000) == [(0x6000, 1), (0x6041, 0), (0x6000, 2)]
    many = places([ChannelSpec(name=str(n)) for n in range(201)], 0x7000)
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
