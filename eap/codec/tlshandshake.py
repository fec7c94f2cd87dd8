"""Certificates in handshakes of TLS 1.2: the one that the other end shows, and fingerprints.

A server that knows its clients by fingerprints has to see a certificate before OpenSSL decides on
it.  Until the encryption begins it is there in clear text (RFC 5246, 7.4.2 and 7.4.6).
"""

from __future__ import annotations

from collections.abc import Iterator
from hashlib import sha256

from eap.codec.wire import Buffer


def fingerprint_of(certificate: bytes) -> str:
    """Return the fingerprint (SHA-256) of a certificate in DER, as OpenSSL writes it."""
    digest = sha256(certificate).hexdigest().upper()
    return ":".join(digest[at : at + 2] for at in range(0, len(digest), 2))


def parse_fingerprint(text: str) -> str:
    """Return a fingerprint in the form of :func:`fingerprint_of`; colons and case do not count.

    Raises:
        ValueError: *text* is none.
    """
    digits = text.replace(":", "").replace(" ", "")
    if len(digits) != 2 * sha256().digest_size or not set(digits) <= set("0123456789abcdefABCDEF"):
        raise ValueError(f"{text!r} is no SHA-256 fingerprint (64 hexadecimal digits)")
    digits = digits.upper()
    return ":".join(digits[at : at + 2] for at in range(0, len(digits), 2))


_RECORD_HEADER, _MESSAGE_HEADER = 5, 4
_HANDSHAKE, _CERTIFICATE = 22, 11
_LIST_HEADER = 3
_SEQUENCE, _VERSION_TAG = 0x30, 0xA0
_LONG_FORM = 0x80
MAX_HANDSHAKE = 24 << 10
"""Limit of the bytes of a handshake in which a certificate is looked for."""


def find_certificate(received: Buffer) -> bytes | None:
    """Return the certificate (DER) that the other end shows in a handshake of TLS 1.2.

    Args:
        received: All bytes from the other end since the connection began.

    Returns:
        The end's own certificate, the first of its chain; None if it has not come, or never will.
    """
    for kind, body in _messages(b"".join(_handshake_records(bytes(received)))):
        if kind == _CERTIFICATE:
            start = 2 * _LIST_HEADER
            size = int.from_bytes(body[_LIST_HEADER:start], "big")
            return body[start : start + size] if 0 < size <= len(body) - start else None
    return None


def _handshake_records(received: bytes) -> Iterator[bytes]:
    """Yield the contents of whole handshake records (RFC 5246, 6.2.1), up to another record."""
    at = 0
    while at + _RECORD_HEADER <= len(received) and received[at] == _HANDSHAKE:
        start = at + _RECORD_HEADER
        at = start + int.from_bytes(received[start - 2 : start], "big")
        if at > len(received):
            return
        yield received[start:at]


def _messages(handshake: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield type and body of whole handshake messages (RFC 5246, 7.4)."""
    at = 0
    while at + _MESSAGE_HEADER <= len(handshake):
        start = at + _MESSAGE_HEADER
        kind, at = handshake[at], start + int.from_bytes(handshake[at + 1 : start], "big")
        if at > len(handshake):
            return
        yield kind, handshake[start:at]


def is_self_issued(certificate: bytes) -> bool:
    """Return whether issuer and subject of a certificate are the same (RFC 5280, 3.2).

    Args:
        certificate: In DER; False for what cannot be read.
    """
    try:
        tag, whole, _ = _element(certificate)
        inner_tag, inner, _ = _element(whole)
        if tag != _SEQUENCE or inner_tag != _SEQUENCE:
            return False
        if inner[:1] == bytes([_VERSION_TAG]):
            _, _, inner = _element(inner)
        _, _, inner = _element(inner)  # serial number
        _, _, inner = _element(inner)  # algorithm of the signature
        _, issuer, inner = _element(inner)
        _, _, inner = _element(inner)  # validity
        _, subject, _ = _element(inner)
    except ValueError:
        return False
    return issuer == subject


def _element(data: bytes) -> tuple[int, bytes, bytes]:
    """Return tag, content and what follows of the first element; raise ValueError if it is cut."""
    if len(data) < 2:
        raise ValueError("no element")
    size, start = data[1], 2
    if size & _LONG_FORM:
        start += size & ~_LONG_FORM
        size = int.from_bytes(data[2:start], "big")
    if start + size > len(data):
        raise ValueError("a cut element")
    return data[0], data[start : start + size], data[start + size :]
