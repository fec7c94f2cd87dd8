from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ids import Destination, MacAddr, NetId
from eap.pd.address import from_word, net_id_of, to_word

macs = st.binary(min_size=6, max_size=6).map(lambda octets: str(MacAddr(octets)))
ports = st.integers(0, 65535).map(lambda port: f":{port}" if port else "")
hosts = st.builds(str.__add__, st.ip_addresses(v=4).map(str), ports)


@given(macs | hosts | hosts.map("tcp://".__add__))
def test_round_trip(text: str) -> None:
    word = to_word(text)
    assert 0 < word < 1 << 63
    assert from_word(word) == Destination.parse(text)


@pytest.mark.parametrize("text", ["", "5.23.91.23.2.1", "whoever asks"])
def test_what_is_no_address_is_zero(text: str) -> None:
    assert to_word(text) == 0


def test_zero_is_no_address() -> None:
    assert from_word(0) is None
    assert from_word(to_word("00:00:00:00:00:00")) is not None


def test_net_ids_are_told_from_addresses() -> None:
    assert net_id_of("5.23.91.23.2.1") == NetId.parse("5.23.91.23.2.1")
    for text in ("10.0.0.1", "02:00:00:00:00:01", "tcp://10.0.0.1", "", "a.b.c.d.e.f"):
        assert net_id_of(text) is None
