from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes, pdo
from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_mapping import (
    MappingEntry,
    check_mapped,
    encode_mapping,
    lay_out_mapping,
    mapped_bits,
)
from eap.device.eap_objects import EapObjects
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.model import Access
from tests.support.downloads import variable, write
from tests.support.stations import BLANK, TYPES


@given(st.integers(0, 0xFFFF_FFFF))
def test_an_entry_is_index_subindex_and_length(word):
    mapped = MappingEntry.decode(word)
    assert mapped.encode() == word
    assert (mapped.target, mapped.subindex, mapped.bits) == (
        word >> 16,
        word >> 8 & 255,
        word & 255,
    )


@given(st.lists(st.sampled_from(TYPES), max_size=30))
def test_padding_is_what_the_layout_of_a_pd_leaves_out(texts):
    kinds = [datatypes.parse(text) for text in texts]
    dictionary = EapDictionary(BLANK, "eap0")
    for number, text in enumerate(texts):
        variable(dictionary, 0x6000 + number, f"v{number}", text)
    words = encode_mapping((0x6000 + number, kind) for number, kind in enumerate(kinds))
    for subindex, word in enumerate(words, 1):
        write(dictionary, 0x1A00, subindex, word)
    write(dictionary, 0x1A00, 0, len(words))
    placed = lay_out_mapping(dictionary, 0x1A00, len(words), 65535)
    assert placed.octets == pdo.layout(kinds).size
    assert placed.indexes == tuple(range(0x6000, 0x6000 + len(texts)))
    assert -(-mapped_bits(dictionary, dictionary[0x1A00]) // 8) == placed.octets


def test_a_mapping_has_254_entries_padding_included():
    bit, word = datatypes.parse("BOOL"), datatypes.parse("UINT")
    assert len(encode_mapping([(0x6000, bit)] * 254)) == 254
    with pytest.raises(ValueError, match="at most 254 entries, this PD needs 258"):
        encode_mapping([(0x6000, bit), (0x6001, word)] * 86)


@pytest.mark.parametrize(
    ("code", "word"),
    [
        (AbortCode.NO_OBJECT, 0x6009_0110),
        (AbortCode.NO_SUBINDEX, 0x6000_2010),
        (AbortCode.NOT_MAPPABLE, 0x6000_0510),
        (AbortCode.NOT_MAPPABLE, 0x0000_0008),
        (AbortCode.NOT_MAPPABLE, 0x0000_0000),
        (AbortCode.NOT_MAPPABLE, 0x0000_0101),
        (AbortCode.LENGTH, 0x6000_0120),
    ],
)
def test_what_cannot_be_mapped_is_refused_where_it_is_written(udp, code, word):
    variable(udp, 0x6000, "level")
    with pytest.raises(SdoAbortError) as caught:
        check_mapped(udp, word, Access.TX_MAPPABLE, 0x1A03, 4)
    assert caught.value.code == code
    assert (caught.value.index, caught.value.subindex) == (0x1A03, 4)


def test_a_received_variable_is_sent_on_but_a_sent_one_is_not_received(udp):
    variable(udp, 0x6000, "level")
    variable(udp, 0x7000, "limit")
    check_mapped(udp, 0x7000_0110, Access.TX_MAPPABLE, 0x1A00, 1)
    check_mapped(udp, 0x7000_0110, Access.RX_MAPPABLE, 0x1600, 1)
    with pytest.raises(SdoAbortError):
        check_mapped(udp, 0x6000_0110, Access.RX_MAPPABLE, 0x1600, 1)


def test_a_mapping_that_no_longer_holds_counts_what_is_left(udp: EapObjects):
    variable(udp, 0x6000, "level")
    write(udp, 0x1A00, 1, 0x6000_0110)
    write(udp, 0x1A00, 0, 1)
    udp.remove(0x6000)
    assert mapped_bits(udp, udp[0x1A00]) == 0
    with pytest.raises(SdoAbortError) as caught:
        lay_out_mapping(udp, 0x1A00, 1, 100)
    assert caught.value.code == AbortCode.NO_OBJECT
