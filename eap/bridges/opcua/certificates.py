"""Certificates: the server's own, made at its first start, and those of trusted clients.

They are kept in the folder ``opcua`` of the plant's state: ``own.pem`` and ``own.key``, ``trusted``
with a file for each trusted client or certificate authority, and ``rejected`` with clients that
tried and are not trusted, to be moved over by the user.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from eap.errors import EnvironmentalError
from eap.runtime.durable import whole_file

_KEY_BITS = 2048
_YEARS = 10
_CERTIFICATE, _KEY = "own.pem", "own.key"
_MAX_REJECTED = 32
_MAX_CERTIFICATE = 16 << 10
_NAMES = ("*.der", "*.pem", "*.crt", "*.cer")


class UntrustedError(Exception):
    """Certificate of a client that is not trusted; the text is the reason."""


class OwnCertificate(NamedTuple):
    """Certificate of the server with its private key, and the URI of the server in it."""

    certificate: x509.Certificate
    key: rsa.RSAPrivateKey
    application_uri: str


def own_certificate(folder: Path, plant: str, hosts: list[str]) -> OwnCertificate:
    """Return the certificate of the server, which is made unless *folder* has a valid one.

    Args:
        folder: Folder of the server's state.
        plant: Name of the plant.
        hosts: Addresses and names by which clients reach the server.

    Raises:
        EnvironmentalError: it cannot be kept.
    """
    uri = application_uri(plant)
    try:
        kept = given_certificate(folder / _CERTIFICATE, folder / _KEY, plant)
    except EnvironmentalError:
        kept = None
    # A new host name or plant makes the URI another one, which clients compare with the
    # certificate.
    is_valid = kept is not None and kept.certificate.not_valid_after_utc > datetime.now(UTC)
    if kept is not None and is_valid and kept.application_uri == uri:
        return kept
    key = rsa.generate_private_key(public_exponent=65537, key_size=_KEY_BITS)
    certificate = _make(key, uri, plant, hosts)
    encoded_key = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for name, data in (
            (_KEY, encoded_key),
            (_CERTIFICATE, certificate.public_bytes(serialization.Encoding.PEM)),
        ):
            with whole_file(folder / name) as file:
                os.fchmod(file.fileno(), 0o600)
                file.write(data)
    except OSError as exc:
        raise EnvironmentalError(f"{folder} cannot keep the certificate: {exc.strerror}") from None
    return OwnCertificate(certificate, key, uri)


def given_certificate(certificate: Path, key: Path, plant: str) -> OwnCertificate:
    """Read a certificate and its key; raise EnvironmentalError if they are none."""
    try:
        loaded = _load(certificate.read_bytes())
        loaded_key = serialization.load_pem_private_key(key.read_bytes(), None)
        uris = _uris(loaded)
    except (OSError, ValueError, TypeError, UnsupportedAlgorithm) as exc:
        raise EnvironmentalError(f"certificate {certificate}, key {key}: {exc}") from None
    if not isinstance(loaded_key, rsa.RSAPrivateKey):
        raise EnvironmentalError(f"key {key}: it is not RSA, which OPC UA needs")
    if loaded_key.public_key() != loaded.public_key():
        raise EnvironmentalError(f"key {key}: it is not that of certificate {certificate}")
    return OwnCertificate(loaded, loaded_key, uris[0] if uris else application_uri(plant))


def application_uri(plant: str) -> str:
    """Return the URI of the server, which its certificate names."""
    return f"urn:{socket.gethostname()}:eap:{plant}"


def _make(key: rsa.RSAPrivateKey, uri: str, plant: str, hosts: list[str]) -> x509.Certificate:
    now = datetime.now(UTC)
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"eap {plant}"[:64])])
    names: list[x509.GeneralName] = [x509.UniformResourceIdentifier(uri)]
    # Clients compare the host that they connect to with these names.
    for host in dict.fromkeys((*hosts, socket.gethostname(), "localhost")):
        try:
            names.append(x509.IPAddress(ip_address(host)))
        except ValueError:
            names.append(x509.DNSName(host))
    usage = x509.KeyUsage(
        digital_signature=True,
        content_commitment=True,
        key_encipherment=True,
        data_encipherment=True,
        key_agreement=False,
        key_cert_sign=True,  # of itself
        crl_sign=False,
        encipher_only=False,
        decipher_only=False,
    )
    purposes = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
    return (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        # The clocks of clients may be behind.
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=365 * _YEARS))
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )


class TrustStore:
    """Certificates of clients that may open a secure channel.

    Args:
        folder: Folder of the server's state.
        trusts_all: True if every valid certificate is trusted.
    """

    def __init__(self, folder: Path, *, trusts_all: bool) -> None:
        self.trusted = folder / "trusted"
        self.rejected = folder / "rejected"
        self._trusts_all = trusts_all
        for path in (self.trusted, self.rejected):
            try:
                path.mkdir(mode=0o700, parents=True, exist_ok=True)
            except OSError as exc:
                raise EnvironmentalError(f"{path} cannot be made: {exc.strerror}") from None

    def check(self, encoded: bytes, now: datetime) -> None:
        """Raise UntrustedError if a client's certificate is not valid now, or not trusted.

        Files are read anew each time, so that a certificate is trusted as soon as it is there.
        """
        # A chain of certificates is the client's own followed by those that issued it.
        try:
            certificate = _load(_first_of(encoded))
            public_key = certificate.public_key()
        except ValueError:
            raise UntrustedError("its certificate is malformed") from None
        name = certificate.subject.rfc4514_string()[:100]
        if not isinstance(public_key, rsa.RSAPublicKey) or public_key.key_size < _KEY_BITS:
            raise UntrustedError(f"certificate {name}: its key is not RSA with {_KEY_BITS} bits")
        if not certificate.not_valid_before_utc <= now <= certificate.not_valid_after_utc:
            raise UntrustedError(f"certificate {name} is not valid now")
        if self._trusts_all or any(map(_trusts(certificate), self._files())):
            return
        path = self._keep(certificate)
        raise UntrustedError(
            f"certificate {name} is not trusted: move {path} to {self.trusted} to trust it"
        )

    def _files(self) -> Iterator[x509.Certificate]:
        for pattern in _NAMES:
            for path in self.trusted.glob(pattern):
                try:
                    yield _load(path.read_bytes())
                except (OSError, ValueError):
                    continue

    def _keep(self, certificate: x509.Certificate) -> Path:
        """Keep a rejected certificate for the user; of many the oldest is forgotten."""
        digest = certificate.fingerprint(hashes.SHA256()).hex()
        path = self.rejected / f"{digest[:16]}.der"
        try:
            if not path.exists():
                kept = sorted(self.rejected.glob("*.der"), key=lambda each: each.stat().st_mtime)
                for old in kept[: max(0, len(kept) - _MAX_REJECTED + 1)]:
                    old.unlink()
                path.write_bytes(certificate.public_bytes(serialization.Encoding.DER))
        except OSError:
            pass  # a full disk: it is refused nevertheless
        return path


def _trusts(certificate: x509.Certificate) -> Callable[[x509.Certificate], bool]:
    def trusts(trusted: x509.Certificate) -> bool:
        if trusted == certificate:
            return True
        try:
            constraints = trusted.extensions.get_extension_for_class(x509.BasicConstraints)
            # Another client that is trusted must not issue certificates.
            if not constraints.value.ca:
                return False
            certificate.verify_directly_issued_by(trusted)
        except (x509.ExtensionNotFound, InvalidSignature, ValueError, TypeError):
            return False
        return True

    return trusts


def _load(data: bytes) -> x509.Certificate:
    if len(data) > _MAX_CERTIFICATE:
        raise ValueError("the certificate is too long")
    if data.lstrip().startswith(b"-----BEGIN"):
        return x509.load_pem_x509_certificate(data)
    return x509.load_der_x509_certificate(data)


def _first_of(chain: bytes) -> bytes:
    """Return the first of several DER certificates in a row."""
    if len(chain) < 4 or chain[:2] != b"\x30\x82":
        return chain
    return chain[: 4 + int.from_bytes(chain[2:4], "big")]


def _uris(certificate: x509.Certificate) -> list[str]:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName)
    except x509.ExtensionNotFound:
        return []
    return names.value.get_values_for_type(x509.UniformResourceIdentifier)
