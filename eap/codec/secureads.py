"""Secure ADS: the message that both ends of AMS over TLS exchange first (TCP 8016).

Beckhoff documents set-up and certificates, not this message; its layout is that of the public
description in ``kevinherron/beckhoff-secure-ads``.  Behind it AMS packets follow without the prefix
of AMS/TCP.

Rule: a message is sent exactly as described, 64 bytes and then user and password.  One with unknown
flags, a longer length or values in reserved bytes is read.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from hashlib import sha256
from typing import Annotated, NamedTuple

from eap.codec.wire import Buffer, Scalar, WireStruct, net_id, u8, u16
from eap.errors import CodecError, MalformedError, TruncatedError
from eap.ids import NetId

AMS_TLS_PORT = 8016
VERSION = 1
MAX_LENGTH = 512
"""Limit of the bytes of a message that is sent."""
LONGEST = 1024
"""Limit of the bytes of a message that is read: more than any user and password need."""
_HOST_SIZE = 32
_ENCODING = "cp1252"
# The five bytes that Windows-1252 leaves undefined stand for themselves, as Windows has them.
_UNDEFINED = {each: chr(each) for each in (0x81, 0x8D, 0x8F, 0x90, 0x9D)}

octets18 = Annotated[bytes, Scalar("18s")]
octets32 = Annotated[bytes, Scalar("32s")]


class ConnectFlag(IntFlag):
    """Bits of *flags*."""

    RESPONSE = 0x01
    AMS_ALLOWED = 0x02
    """Of a response: AMS packets may follow."""
    SERVER_INFO = 0x04
    """The route has a fingerprint and no address."""
    OWN_FILE = 0x08
    SELF_SIGNED = 0x10
    IP_ADDRESS = 0x20
    """The route leads to the address, not to the host name."""
    IGNORE_NAME = 0x40
    """The common name of the certificate is not compared."""
    ADD_REMOTE = 0x80
    """Requests a route, with user and password."""


class ConnectError(IntEnum):
    """Values of *error* in a response."""

    NONE = 0
    VERSION = 1
    NAME = 2
    """The common name of the certificate does not match."""
    CERTIFICATE = 3
    """The certificate is not known."""
    USER = 4
    """User or password is wrong, or the client is not known."""

    @classmethod
    def words_of(cls, error: int) -> str:
        """Return an error in words, as the far end means it."""
        return _WORDS.get(error, f"error {error}")


_WORDS: dict[int, str] = {
    ConnectError.VERSION: "it does not know this version of the protocol",
    ConnectError.NAME: "the name in the certificate of this station is not the one it expects",
    ConnectError.CERTIFICATE: "it does not know the certificate of this station",
    ConnectError.USER: "it does not know this station, or refuses user and password",
}


class TlsConnectInfo(WireStruct, frozen=True):
    """Fixed part of the message (``TlsConnectInfo``), the same in both directions.

    *length* counts the whole message; *net_id* is the router's that sends it.
    """

    length: u16
    flags: u16
    version: u8
    error: u8
    net_id: net_id
    user_length: u8
    password_length: u8
    reserved: octets18
    host: octets32


class ConnectInfo(NamedTuple):
    """A message."""

    net_id: NetId
    flags: int = 0
    host: str = ""
    error: int = 0
    user: bytes = b""
    """In Windows-1252, like *password*."""
    password: bytes = b""
    version: int = VERSION

    def encode(self) -> bytes:
        """Return the message; a host of more than 32 bytes is cut.

        Raises:
            CodecError: user or password is too long, or one is there without the other.
        """
        length = TlsConnectInfo.SIZE + len(self.user) + len(self.password)
        if bool(self.user) != bool(self.password):
            raise CodecError("user and password belong together", layout="TlsConnectInfo")
        if length > MAX_LENGTH:
            text = f"{length} bytes with user and password, expected {MAX_LENGTH} or less"
            raise CodecError(text, layout="TlsConnectInfo")
        head = TlsConnectInfo(
            *(length, self.flags, self.version, self.error, self.net_id),
            *(len(self.user), len(self.password), bytes(18)),
            encode_ansi(self.host)[:_HOST_SIZE].ljust(_HOST_SIZE, b"\0"),
        )
        return head.encode() + self.user + self.password


def length_of(data: Buffer) -> int | None:
    """Return the length of the message that begins with *data*, None if that is not known yet.

    Raises:
        MalformedError: no message has that length.
    """
    if len(data) < 2:
        return None
    length = int.from_bytes(data[:2], "little")
    # Found before the bytes are waited for: a peer could have kept them away until the time-out.
    if not TlsConnectInfo.SIZE <= length <= LONGEST:
        raise MalformedError(
            f"length {length}, expected {TlsConnectInfo.SIZE} to {LONGEST}", layout="TlsConnectInfo"
        )
    return length


def decode_connect_info(data: Buffer) -> ConnectInfo:
    """Read the message at the begin of *data*; bytes behind it are ignored.

    Raises:
        TruncatedError: the message is not whole.
        MalformedError: user and password do not fit in its length.
    """
    head = TlsConnectInfo.decode(data)
    length = length_of(data) or 0
    if len(data) < length:
        raise TruncatedError(f"length {length}, {len(data)} bytes here", layout="TlsConnectInfo")
    at = TlsConnectInfo.SIZE
    middle = at + head.user_length
    end = middle + head.password_length
    if end > length:
        text = f"user and password of {end - at} bytes, but {length - at} follow"
        raise MalformedError(text, layout="TlsConnectInfo", offset=12)
    return ConnectInfo(
        *(head.net_id, head.flags, decode_ansi(head.host.partition(b"\0")[0]), head.error),
        *(bytes(data[at:middle]), bytes(data[middle:end]), head.version),
    )


def encode_ansi(text: str) -> bytes:
    """Return *text* in Windows-1252; what it has not becomes a question mark."""
    return b"".join(
        bytes([ord(each)]) if ord(each) in _UNDEFINED else each.encode(_ENCODING, errors="replace")
        for each in text
    )


def decode_ansi(data: bytes) -> str:
    """Return the text of bytes in Windows-1252."""
    return "".join(_UNDEFINED.get(each) or bytes([each]).decode(_ENCODING) for each in data)


def psk_of(identity: str, password: bytes) -> bytes:
    """Return the pre-shared key of an identity, whose case does not count, and its password."""
    return sha256(identity.upper().encode() + password).digest()
