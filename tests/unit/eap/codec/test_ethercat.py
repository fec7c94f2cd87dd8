from __future__ import annotations

import pytest

from eap.codec.ethercat import EAP_PORT, EtherCatHeader, FrameType
from eap.errors import CodecError


def test_length_and_type_share_a_little_endian_word() -> None:
    assert EtherCatHeader(0x15).encode() == b"\x15\x40"
    assert EtherCatHeader(0x7FF, reserved=1, type=FrameType.DATAGRAM).encode() == b"\xff\x1f"
    assert EtherCatHeader.decode(b"\x15\x40") == EtherCatHeader(0x15, 0, FrameType.PROCESS_DATA)


def test_undocumented_type_keeps_its_number() -> None:
    header = EtherCatHeader.decode(b"\x15\x70")
    assert (header.length, header.type) == (21, 7)


def test_length_beyond_eleven_bits_is_refused() -> None:
    with pytest.raises(CodecError, match="EtherCatHeader"):
        EtherCatHeader(2048).encode()


def test_port_is_the_number_of_the_standard() -> None:
    assert EAP_PORT == 34980
