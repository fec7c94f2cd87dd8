from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.mailbox import VoeHeader
from eap.errors import TruncatedError
from tests.support.vectors import load_message
from tests.support.wirerecords import records


def test_header_lies_as_on_the_wire() -> None:
    assert VoeHeader(2, 0x1234).encode() == bytes.fromhex("02000000 3412")


@given(records(VoeHeader), st.integers(0, VoeHeader.SIZE - 1))
def test_round_trip_and_every_prefix_is_truncated(header: VoeHeader, cut: int) -> None:
    assert VoeHeader.decode(header.encode() + b"data") == header
    with pytest.raises(TruncatedError, match="VoeHeader"):
        VoeHeader.decode(header.encode()[:cut])


def test_vector() -> None:
    octets = load_message("voe")
    header = VoeHeader.decode(octets)
    assert header == VoeHeader(0x1164, 1)
    assert header.encode() + b"\1\2" == octets
