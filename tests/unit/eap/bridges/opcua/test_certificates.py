from __future__ import annotations

from datetime import UTC, datetime, timedelta
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from eap.errors import EnvironmentalError

pytestmark = pytest.mark.skipif(
    find_spec("asyncua") is None, reason="needs asyncua: pip install asyncua"
)
NOW = datetime.now(UTC)


def certificate(issuer: Any = None, *, bits: int = 2048, days: int = 30, ca: bool = False) -> Any:
    """Return a certificate and its key, issued by *issuer* or by itself."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import rsa

    key = rsa.generate_private_key(public_exponent=65537, key_size=bits)
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "works CA" if ca else "panel")])
    signer, above = (key, name) if issuer is None else (issuer[1], issuer[0].subject)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(above)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(NOW - timedelta(days=60))
        .not_valid_after(NOW + timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=ca, path_length=None), critical=True)
        .sign(signer, hashes.SHA256())
    )
    return made, key


def der(made: Any) -> bytes:
    from cryptography.hazmat.primitives.serialization import Encoding

    encoded: bytes = made[0].public_bytes(Encoding.DER)
    return encoded


def refusal(folder: Path, encoded: bytes, *, trusts_all: bool = False) -> str:
    from eap.bridges.opcua.certificates import TrustStore, UntrustedError

    try:
        TrustStore(folder, trusts_all=trusts_all).check(encoded, NOW)
    except UntrustedError as exc:
        return str(exc)
    return ""


def test_own_certificate_is_made_once_and_names_the_server(tmp_path):
    from eap.bridges.opcua.certificates import own_certificate

    made = own_certificate(tmp_path / "opcua", "press", ["10.0.0.5"])
    again = own_certificate(tmp_path / "opcua", "press", ["10.0.0.5"])
    assert again.certificate == made.certificate
    assert again.application_uri.endswith(":eap:press")
    assert (tmp_path / "opcua" / "own.key").stat().st_mode & 0o077 == 0
    other = own_certificate(tmp_path / "opcua", "mill", [])
    assert other.certificate != made.certificate


def test_certificate_of_another_key_is_refused(tmp_path):
    from eap.bridges.opcua.certificates import given_certificate, own_certificate

    for name in ("one", "two"):
        own_certificate(tmp_path / name, name, [])
    with pytest.raises(EnvironmentalError, match="it is not that of certificate"):
        given_certificate(tmp_path / "one/own.pem", tmp_path / "two/own.key", "press")


def test_client_is_trusted_when_its_certificate_is_in_the_folder(tmp_path):
    client = certificate()
    assert "is not trusted: move" in refusal(tmp_path, der(client))
    (rejected,) = (tmp_path / "rejected").iterdir()
    assert rejected.read_bytes() == der(client)
    rejected.rename(tmp_path / "trusted" / rejected.name)
    assert refusal(tmp_path, der(client)) == ""
    assert "is not trusted" in refusal(tmp_path, der(certificate()))


def test_authority_in_the_folder_stands_for_what_it_issued(tmp_path):
    authority, stranger = certificate(ca=True), certificate()
    client = certificate(authority)
    assert "is not trusted" in refusal(tmp_path, der(client))
    (tmp_path / "trusted" / "works.crt").write_bytes(der(authority))
    assert refusal(tmp_path, der(client)) == ""
    # The chain of a client: its certificate, then those that issued it.
    assert refusal(tmp_path, der(client) + der(authority)) == ""
    assert "is not trusted" in refusal(tmp_path, der(stranger) + der(authority))
    # A trusted client is no authority.
    (tmp_path / "trusted" / "panel.der").write_bytes(der(stranger))
    assert "is not trusted" in refusal(tmp_path, der(certificate(stranger)))


@pytest.mark.parametrize(
    ("encoded", "reason"),
    [
        (lambda: der(certificate(days=-1)), "is not valid now"),
        (lambda: der(certificate(bits=1024)), "its key is not RSA with 2048 bits"),
        (lambda: b"", "malformed"),
        (lambda: b"\x30\x82\xff\xff" + bytes(40), "malformed"),
    ],
)
def test_invalid_certificate_is_refused_even_if_all_are_trusted(tmp_path, encoded, reason):
    assert reason in refusal(tmp_path, encoded(), trusts_all=True)


def test_rejected_certificates_are_bounded(tmp_path):
    from eap.bridges.opcua.certificates import TrustStore

    TrustStore(tmp_path, trusts_all=False)
    for number in range(40):
        (tmp_path / "rejected" / f"{number:016x}.der").touch()
    refusal(tmp_path, der(certificate()))
    assert len(list((tmp_path / "rejected").iterdir())) == 32
