"""The message of Secure ADS that both ends exchange behind TLS."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.secureads import (
    LONGEST,
    MAX_LENGTH,
    ConnectError,
    ConnectFlag,
    ConnectInfo,
    TlsConnectInfo,
    decode_ansi,
    decode_connect_info,
    encode_ansi,
    length_of,
    psk_of,
)
from eap.errors import CodecError, MalformedError, TruncatedError
from eap.ids import NetId
from tests.support.vectors import load
from tests.support.wirerecords import records

net_ids = st.binary(min_size=6, max_size=6).map(NetId)
hosts = st.binary(max_size=32).filter(lambda each: 0 not in each).map(decode_ansi)
logins = st.tuples(st.binary(min_size=1, max_size=200), st.binary(min_size=1, max_size=200))
infos = st.builds(
    lambda net_id, flags, host, error, login, version: ConnectInfo(
        net_id, flags, host, error, *login, version
    ),
    *(net_ids, st.integers(0, 0xFFFF), hosts, st.integers(0, 255)),
    *(st.just((b"", b"")) | logins, st.integers(0, 255)),
)


def test_layout_has_64_bytes() -> None:
    assert TlsConnectInfo.SIZE == 64


@given(infos, st.binary(max_size=9))
def test_connect_info_survives_its_bytes(info: ConnectInfo, surplus: bytes) -> None:
    octets = info.encode()
    assert length_of(octets) == len(octets) <= MAX_LENGTH
    assert decode_connect_info(octets + surplus) == info


@given(infos, st.data())
def test_every_prefix_is_truncated(info: ConnectInfo, data: st.DataObject) -> None:
    octets = info.encode()
    cut = octets[: data.draw(st.integers(0, len(octets) - 1))]
    assert length_of(cut) in {None, len(octets)}
    with pytest.raises(TruncatedError):
        decode_connect_info(cut)


@given(st.binary(max_size=120) | records(TlsConnectInfo).map(lambda each: each.encode()))
def test_any_bytes_are_read_or_refused(octets: bytes) -> None:
    try:
        read = decode_connect_info(octets)
    except CodecError:
        return
    assert decode_connect_info(read._replace(user=b"", password=b"").encode()).host == read.host


@pytest.mark.parametrize("length", [0, 63, LONGEST + 1, 0xFFFF])
def test_impossible_length_is_refused(length: int) -> None:
    with pytest.raises(MalformedError, match="expected 64 to 1024"):
        length_of(length.to_bytes(2, "little"))


def test_user_beyond_the_length_is_refused() -> None:
    octets = bytearray(ConnectInfo(NetId(bytes(6))).encode())
    octets[12] = 1
    with pytest.raises(MalformedError, match="user and password of 1 bytes, but 0 follow"):
        decode_connect_info(octets)


def test_user_needs_a_password_and_both_fit_in_512_bytes() -> None:
    with pytest.raises(CodecError, match="belong together"):
        ConnectInfo(NetId(bytes(6)), user=b"a").encode()
    with pytest.raises(CodecError, match="512 or less"):
        ConnectInfo(NetId(bytes(6)), user=b"a" * 225, password=b"b" * 224).encode()


def test_long_host_is_cut_and_strange_letters_are_replaced() -> None:
    info = ConnectInfo(NetId(bytes(6)), host="Prüfstand 漢" + 40 * "x")
    assert decode_connect_info(info.encode()).host == "Prüfstand ?" + 21 * "x"


def test_every_byte_is_a_letter_of_its_own() -> None:
    assert encode_ansi(decode_ansi(bytes(range(256)))) == bytes(range(256))


def test_key_is_the_digest_of_identity_in_capitals_and_password() -> None:
    # printf 'MY-CLIENTmy-secret-password' | sha256sum
    digest = "377214162e705b900cb2e9d210c7069e9f6da7aeaba9c3633af6627782380db1"
    assert psk_of("my-client", b"my-secret-password").hex() == digest
    assert psk_of("My-Client", b"my-secret-password").hex() == digest


def test_errors_have_words() -> None:
    assert "certificate" in ConnectError.words_of(ConnectError.CERTIFICATE)
    assert ConnectError.words_of(77) == "error 77"


def test_flags_are_those_of_the_description() -> None:
    (request,) = (each for each in load("secure_ads") if each.name.endswith("add_remote"))
    flags = decode_connect_info(request.octets).flags
    wanted = ConnectFlag.ADD_REMOTE | ConnectFlag.IGNORE_NAME | ConnectFlag.IP_ADDRESS
    assert flags == wanted | ConnectFlag.SELF_SIGNED
