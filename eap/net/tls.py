"""TLS of Secure ADS: contexts of both ends, and their judgement of the certificate at the far end.

TLS 1.2 alone, as the public description has it, without renegotiation and tickets.

OpenSSL trusts certificates of authorities, and :mod:`ssl` cannot ask a server's program about any
other.  A client with a self-signed certificate, which is known by its fingerprint, has to pass
nevertheless: the server reads the certificate from the handshake, where it is in clear text, and
makes it an authority of that one connection before OpenSSL sees it.  OpenSSL then checks that the
client has the key.  Whether the client may do anything is decided after that, by the fingerprint.
"""

from __future__ import annotations

import ssl
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from eap.ams.spec import PskSpec, SecureAdsSpec, SecureRouteSpec
from eap.codec.secureads import psk_of
from eap.codec.tlshandshake import MAX_HANDSHAKE, find_certificate, fingerprint_of, is_self_issued
from eap.errors import EnvironmentalError
from eap.net.host import read_password

# The last two are those of clients on older Java.
_CIPHERS = "ECDHE+AESGCM:ECDHE+CHACHA20:DHE+AESGCM:DHE-RSA-AES256-SHA256:DHE-RSA-AES128-SHA256"
_PSK_CIPHERS = "PSK-AES256-CBC-SHA384:PSK-AES128-CBC-SHA256:PSK-AES256-CBC-SHA:PSK-AES128-CBC-SHA"
_DH_PARAMETERS = Path(__file__).with_name("ffdhe2048.pem")
"""Group ffdhe2048 (RFC 7919): without one, no method with DHE is offered."""
HAS_PSK = hasattr(ssl.SSLContext, "set_psk_server_callback")
"""True if this Python has pre-shared keys: from 3.13 on."""
_PSK_KEY = "PSK"


class TlsPeer(NamedTuple):
    """Far end after its handshake.

    Attributes:
        name: Common name of its certificate, or identity of its pre-shared key; empty for none.
        fingerprint: Of its certificate; empty with a pre-shared key.
        is_trusted: Whether an authority signed its certificate, or it has a pre-shared key.
    """

    name: str
    fingerprint: str
    is_trusted: bool


class ServerContext(ssl.SSLContext):
    """Context of one accepted connection.

    Attributes:
        identity: Of the pre-shared key that the client named.
        incoming: Received bytes that OpenSSL has not read.
    """

    # asyncio hands received bytes over in the BIO, and calls do_handshake() after each of them.
    identity = ""
    incoming: ssl.MemoryBIO

    def __init__(self, protocol: int) -> None:
        del protocol  # is an argument of __new__
        super().__init__()
        self.sslobject_class = _ServerObject
        self._received: bytearray | None = bytearray()
        self._shown: bytes | None = None

    def wrap_bio(
        self, incoming: ssl.MemoryBIO, outgoing: ssl.MemoryBIO, server_side: bool = False,
        server_hostname: str | bytes | None = None, session: ssl.SSLSession | None = None,
    ) -> ssl.SSLObject:  # fmt: skip
        """Return the object of the connection (ssl)."""
        self.incoming = incoming
        return super().wrap_bio(incoming, outgoing, server_side, server_hostname, session)

    def look_for_certificate(self) -> None:
        """Trust the self-signed certificate in the received bytes, if there is one."""
        if self._received is None or not (data := self.incoming.read()):
            return
        self.incoming.write(data)
        self._received += data
        found = find_certificate(self._received)
        if found is None:
            if len(self._received) > MAX_HANDSHAKE:
                self._received = None
            return
        self._received = None
        if is_self_issued(found):
            self._shown = found
            self.load_verify_locations(cadata=found)

    def peer_of(self, connection: ssl.SSLObject) -> TlsPeer:
        """Return the far end of a connection whose handshake is complete."""
        shown = connection.getpeercert(binary_form=True)
        if shown is None:
            return TlsPeer(self.identity, "", bool(self.identity))
        # With an authority of its own making a client could sign any certificate: it gets no
        # further than its fingerprint.
        is_trusted = self._shown is None
        return TlsPeer(common_name(connection), fingerprint_of(shown), is_trusted)


class _ServerObject(ssl.SSLObject):
    """Connection of a server that looks at certificates before OpenSSL does."""

    def do_handshake(self) -> None:
        """Continue the handshake."""
        if isinstance(self.context, ServerContext):
            self.context.look_for_certificate()
        super().do_handshake()


def server_context(spec: SecureAdsSpec) -> ServerContext:
    """Return the context for one connection.

    Raises:
        EnvironmentalError: a file is missing or invalid.
    """
    context = ServerContext(ssl.PROTOCOL_TLS_SERVER)
    keys = {each.identity.upper(): each for each in spec.psk}
    _prepare(context, has_psk=bool(keys))
    context.verify_mode = ssl.CERT_REQUIRED
    # A pinned certificate, or that of an intermediate authority, is enough.
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    _load(context, spec.certificate, spec.key, spec.ca)
    try:
        context.load_dh_params(str(_DH_PARAMETERS))
    except OSError as exc:
        raise EnvironmentalError(f"{_DH_PARAMETERS}: {_file_error(exc)}") from None
    if keys:
        # Python 3.11 has no such method.
        set_callback: Callable[..., None] = getattr(context, "set_psk_server_callback")  # noqa: B009
        set_callback(_find_key(context, keys))
    return context


def _find_key(context: ServerContext, keys: Mapping[str, PskSpec]) -> Callable[[str | None], bytes]:
    def find(identity: str | None) -> bytes:
        spec = keys.get((identity or "").upper())
        if spec is None:
            return b""  # an unknown identity ends the handshake
        context.identity = spec.identity
        return _key_of(spec)

    return find


def _key_of(spec: PskSpec) -> bytes:
    try:
        password = read_password(Path(spec.password_file))
    except EnvironmentalError:
        return b""
    return psk_of(spec.identity, password) if password else b""


def client_context(spec: SecureRouteSpec) -> ssl.SSLContext:
    """Return the context of a connection to the far end of a route.

    Raises:
        EnvironmentalError: a file is missing or invalid, or this Python has no pre-shared keys.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    _prepare(context, has_psk=spec.psk is not None)
    context.check_hostname = False  # see distrust_of()
    if spec.psk is not None:
        _use_key(context, spec.psk)
        return context
    if spec.fingerprint:
        # The handshake proves that the far end has the key; the fingerprint is compared after it.
        context.verify_mode = ssl.CERT_NONE
    _load(context, spec.certificate, spec.key, "" if spec.fingerprint else spec.ca)
    return context


def _use_key(context: ssl.SSLContext, psk: PskSpec) -> None:
    key = _key_of(psk)
    if not key:
        raise EnvironmentalError(f"{psk.password_file}: no password for identity {psk.identity!r}")
    context.verify_mode = ssl.CERT_NONE
    context.set_ciphers(_PSK_CIPHERS)
    set_callback: Callable[..., None] = getattr(context, "set_psk_client_callback")  # noqa: B009
    set_callback(lambda hint: (psk.identity, key))


def distrust_of(spec: SecureRouteSpec, host: str, connection: ssl.SSLObject) -> str:
    """Return why the far end of a route is not the right one; empty if it is.

    Args:
        spec: Settings of the route.
        host: Name or address in the route.
        connection: Its handshake is complete.
    """
    if spec.psk is not None:
        return ""
    shown = fingerprint_of(connection.getpeercert(binary_form=True) or b"")
    if spec.fingerprint:
        if shown == spec.fingerprint:
            return ""
        return f"its certificate has the fingerprint {shown}, not that of the route"
    if not spec.check_name:
        return ""
    names = _names(connection)
    if host.lower() in {each.lower() for each in names}:
        return ""
    known = ", ".join(names) or "nobody"
    return f"its certificate is for {known}, not for {host}; check_name: false allows that"


def common_name(connection: ssl.SSLObject) -> str:
    """Return the common name in the certificate of the far end; empty without one."""
    return next((text for key, text in _subject(connection) if key == "commonName"), "")


def _subject(connection: ssl.SSLObject) -> list[tuple[str, str]]:
    certificate: Mapping[str, tuple[tuple[tuple[str, str], ...], ...]]
    certificate = connection.getpeercert() or {}  # type: ignore[assignment]
    return [pair for part in certificate.get("subject", ()) for pair in part]


def _names(connection: ssl.SSLObject) -> list[str]:
    """Return common name and alternative names of the far end.

    :mod:`ssl` compares an address with alternative names alone; TwinCAT has it as common name.
    """
    certificate: Mapping[str, tuple[tuple[str, str], ...]]
    certificate = connection.getpeercert() or {}  # type: ignore[assignment]
    others = certificate.get("subjectAltName", ())
    names = [common_name(connection), *(name for _, name in others)]
    return [each for each in dict.fromkeys(names) if each]


def _prepare(context: ssl.SSLContext, *, has_psk: bool) -> None:
    context.minimum_version = context.maximum_version = ssl.TLSVersion.TLSv1_2
    context.options |= ssl.OP_NO_RENEGOTIATION | ssl.OP_NO_TICKET | ssl.OP_NO_COMPRESSION
    if has_psk and not HAS_PSK:
        raise EnvironmentalError(PSK_MISSING)
    context.set_ciphers(f"{_CIPHERS}:{_PSK_CIPHERS}" if has_psk else _CIPHERS)


PSK_MISSING = "this Python has no pre-shared keys: they need Python 3.13 or newer; use certificates"


def _load(context: ssl.SSLContext, certificate: str, key: str, ca: str) -> None:
    try:
        if certificate:
            # Without the function OpenSSL asks the terminal for the password of an encrypted key.
            context.load_cert_chain(certificate, key, password=lambda: b"")
    except OSError as exc:
        raise EnvironmentalError(f"{certificate}, {key}: {_file_error(exc)}") from None
    try:
        if ca:
            context.load_verify_locations(ca)
    except OSError as exc:
        raise EnvironmentalError(f"{ca}: {_file_error(exc)}") from None


def _file_error(error: OSError) -> str:
    if isinstance(error, ssl.SSLError):
        return (error.reason or "no certificate or key in PEM").lower().replace("_", " ")
    return error.strerror or str(error)


def words_of(error: OSError) -> str:
    """Return the reason of a failed handshake for people."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"certificate not trusted: {error.verify_message}"
    if isinstance(error, ssl.SSLError):
        reason = (error.reason or "no TLS").lower().replace("_", " ")
        return _REASONS.get(reason, f"TLS: {reason}")
    return error.strerror or str(error) or "closed by the peer"


_REASONS = {
    "tlsv1 alert unknown ca": "the far end does not trust the authority of this certificate",
    "sslv3 alert bad certificate": "the far end does not trust this certificate",
    "sslv3 alert certificate unknown": "the far end does not trust this certificate",
    "sslv3 alert handshake failure": "TLS: no method that both ends have, or no certificate",
    "no shared cipher": "TLS: no method that both ends have",
    "wrong version number": "no TLS at the far end",
    "unsupported protocol": "TLS: the far end has no TLS 1.2",
    "psk identity not found": "the identity of the pre-shared key is not known",
    "peer did not return a certificate": "the far end shows no certificate",
}
