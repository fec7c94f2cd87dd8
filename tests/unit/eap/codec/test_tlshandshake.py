"""Certificates in handshakes of TLS 1.2 that OpenSSL makes."""

from __future__ import annotations

import ssl
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.tlshandshake import (
    find_certificate,
    fingerprint_of,
    is_self_issued,
    parse_fingerprint,
)
from tests.support.certificates import KeyPair, make_certificate


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> KeyPair:
    return make_certificate(tmp_path_factory.mktemp("ca"), "plant-ca")


@pytest.fixture(scope="module")
def client(authority: KeyPair) -> KeyPair:
    return make_certificate(authority.key.parent, "panel", by=authority)


def sent_by_client(own: KeyPair, *, shows: bool = True) -> bytes:
    """Return what a client of OpenSSL sends, up to its last message in clear text."""
    ends = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT), ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    for each in ends:
        each.maximum_version = ssl.TLSVersion.TLSv1_2
        each.check_hostname = False
        each.load_verify_locations(own.certificate)
    ends[0].verify_mode, ends[1].verify_mode = ssl.CERT_NONE, ssl.CERT_OPTIONAL
    ends[1].load_cert_chain(own.certificate, own.key)
    if shows:
        ends[0].load_cert_chain(own.certificate, own.key)
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    talking = (
        ends[0].wrap_bio(to_client, to_server, server_side=False),
        ends[1].wrap_bio(to_server, to_client, server_side=True),
    )
    sent = b""
    for end in (0, 1, 0):
        try:
            talking[end].do_handshake()
        except ssl.SSLWantReadError:
            if end == 0:
                octets = to_server.read()
                sent += octets
                to_server.write(octets)
    return sent


def test_certificate_of_a_client_is_found(authority: KeyPair) -> None:
    sent = sent_by_client(authority)
    assert find_certificate(sent) == authority.der
    assert fingerprint_of(authority.der) == authority.fingerprint


def test_handshake_in_records_of_one_byte_is_read(authority: KeyPair) -> None:
    sent = sent_by_client(authority)
    parts, at = [], 0
    while sent[at] == 22:
        end = at + 5 + int.from_bytes(sent[at + 3 : at + 5], "big")
        parts += [b"\x16\x03\x03\x00\x01" + bytes([each]) for each in sent[at + 5 : end]]
        at = end
    assert find_certificate(b"".join(parts) + sent[at:]) == authority.der


def test_client_without_a_certificate_shows_none(authority: KeyPair) -> None:
    assert find_certificate(sent_by_client(authority, shows=False)) is None


def test_nothing_is_found_until_the_message_is_whole(authority: KeyPair) -> None:
    sent = sent_by_client(authority)
    whole = sent.index(authority.der) + len(authority.der)
    found = [find_certificate(sent[:end]) for end in range(0, whole, 7)]
    assert set(found) == {None}


@given(
    st.binary(max_size=60) | st.binary(max_size=40).map(lambda each: b"\x16\x03\x03\x00\x28" + each)
)
def test_any_bytes_show_a_part_of_them_or_nothing(octets: bytes) -> None:
    found = find_certificate(octets)
    assert found is None or found in octets


def test_self_signed_certificate_is_self_issued(authority: KeyPair, client: KeyPair) -> None:
    assert is_self_issued(authority.der)
    assert not is_self_issued(client.der)


def test_cut_certificate_is_not_self_issued(authority: KeyPair) -> None:
    der = authority.der
    assert not any(is_self_issued(der[:end]) for end in range(len(der)))


@given(st.binary(max_size=40))
def test_any_bytes_are_no_certificate(octets: bytes) -> None:
    is_self_issued(octets)


def test_fingerprint_is_read_with_and_without_colons(client: KeyPair) -> None:
    text = client.fingerprint
    assert parse_fingerprint(text.replace(":", "").lower()) == parse_fingerprint(text) == text


@pytest.mark.parametrize("text", ["", "ab", "g" * 64, "ab" * 31, "ab" * 33])
def test_other_text_is_no_fingerprint(text: str) -> None:
    with pytest.raises(ValueError, match="64 hexadecimal digits"):
        parse_fingerprint(text)


def test_openssl_prints_the_same_fingerprint(client: KeyPair, tmp_path: Path) -> None:
    import subprocess

    printed = subprocess.run(
        ["openssl", "x509", "-in", client.certificate, "-noout", "-fingerprint", "-sha256"],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    assert printed.stdout.strip().endswith(f"={fingerprint_of(client.der)}")
