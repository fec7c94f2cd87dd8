"""Certificates of tests, made by OpenSSL: of an authority, signed by it, and self-signed."""

from __future__ import annotations

import hashlib
import ssl
import subprocess
from pathlib import Path
from typing import NamedTuple


class KeyPair(NamedTuple):
    """Files of a certificate and its key."""

    certificate: Path
    key: Path

    @property
    def der(self) -> bytes:
        return ssl.PEM_cert_to_DER_cert(self.certificate.read_text())

    @property
    def fingerprint(self) -> str:
        """As ``openssl x509 -fingerprint -sha256`` prints it."""
        return hashlib.sha256(self.der).digest().hex(":").upper()


def make_certificate(
    folder: Path, file: str, name: str = "", *, by: KeyPair | None = None, days: int = 9,
    algorithm: str = "ec",
) -> KeyPair:  # fmt: skip
    """Return a certificate with the common name *name*: self-signed, or signed *by* an authority.

    Negative *days* make one of an authority that has expired.
    """
    made = KeyPair(folder / f"{file}.crt", folder / f"{file}.key")
    kind = {"ec": ["ec", "-pkeyopt", "ec_paramgen_curve:P-256"], "rsa": ["rsa:2048"]}[algorithm]
    subject = ["-newkey", *kind, "-nodes", "-subj", f"/CN={name or file}", "-keyout", made.key]
    if by is None:
        _openssl("req", "-x509", "-days", days, *subject, "-out", made.certificate)
        return made
    request = folder / f"{file}.csr"
    _openssl("req", *subject, "-out", request)
    _openssl(
        *("x509", "-req", "-in", request, "-days", days, "-out", made.certificate),
        *("-CA", by.certificate, "-CAkey", by.key, "-CAcreateserial"),
    )
    return made


def _openssl(*arguments: object) -> None:
    subprocess.run(["openssl", *map(str, arguments)], check=True, capture_output=True)
