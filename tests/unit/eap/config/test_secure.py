"""Secure ADS in plant files: specifications, and findings."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from eap.ams.spec import HopSpec, SecureAdsSpec, SecurePeer, SecureRouteSpec, TransportKind
from eap.config.index import ExpectedBus
from eap.config.load import load

PRINT = "ab" * 32
SHOWN = ":".join(["AB"] * 32)
PLANT = """\
plant: line
stations:
  - name: left
    net_id: 10.0.0.1.1.1
    ports: [{{name: eap0, kind: eap, interface: "udp://10.0.0.1", net_id: 10.0.0.1.2.1}}]
    secure_ads: {{{left}}}
    routes: [{{to: right, ams_tcp: {where}, tls: {{{tls}}}}}]
  - name: right
    net_id: 10.0.0.2.1.1
    ports: [{{name: eap0, kind: eap, interface: "udp://10.0.0.2", net_id: 10.0.0.2.2.1}}]
    {right}
"""
OWN = "certificate: pem, key: pem"


def read(tmp_path: Path, *, left=OWN, right="", where="10.0.0.2", tls=f"fingerprint: {PRINT}"):
    (tmp_path / "pem").touch()
    file = tmp_path / "plant.yaml"
    file.write_text(PLANT.format(left=left, right=right, where=where, tls=tls))
    return load(file, lambda path: ExpectedBus())


def findings(tmp_path: Path, **parts: str) -> list[str]:
    return [str(each).partition("plant.yaml:")[2] for each in read(tmp_path, **parts).findings]


def test_station_and_route_have_their_files_and_peers(tmp_path: Path) -> None:
    left = f"{OWN}, ca: pem, peers: {{panel: '{PRINT}'}}, port: 9000"
    found = read(tmp_path, left=left)
    assert findings(tmp_path, left=left) == []
    routing = found.plant.routing["left"]
    pem = str(tmp_path / "pem")
    assert routing.secure == SecureAdsSpec(
        certificate=pem, key=pem, ca=pem, peers=(SecurePeer("panel", SHOWN),), port=9000
    )
    (route,) = (each for each in routing.routes if not each.is_derived)
    assert route.hop == HopSpec(TransportKind.AMS_TLS, "", "10.0.0.2:8016")
    assert route.tls == SecureRouteSpec(fingerprint=SHOWN)
    assert route.tls.complete(routing.secure) == SecureRouteSpec(
        fingerprint=SHOWN, ca=pem, certificate=pem, key=pem
    )


def test_route_to_a_port_of_the_plant_leads_to_the_port_number_of_its_station(tmp_path: Path):
    right = f"secure_ads: {{{OWN}, port: 9001}}"
    found = read(tmp_path, right=right, where="right/eap0")
    assert not found.findings
    (route,) = (each for each in found.plant.routing["left"].routes if not each.is_derived)
    assert route.hop.address == "10.0.0.2:9001"


def test_station_without_secure_ads_has_none(tmp_path: Path) -> None:
    found = read(tmp_path)
    assert found.plant.routing["right"].secure is None


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ({"left": "certificate: gone, key: pem"}, "6: gone: No such file or directory"),
        ({"left": "certificate: pem, key: pem, peers: {a: xy}"}, "6: 'xy' is no SHA-256 finger"),
        ({"left": f"{OWN}, peers: {{'a:b': '{PRINT}'}}"}, "6: peer 'a:b'; expected a name of"),
        ({"tls": f"fingerprint: {PRINT}, key: pem"}, "7: certificate and key belong together"),
        ({"tls": ""}, "7: route 'right' trusts nobody; expected fingerprint, ca or identity"),
        ({"tls": "identity: me"}, "7: identity and password_file belong together"),
        ({"tls": "fingerprint: no"}, "7: 'no' is no SHA-256 fingerprint"),
        ({"where": "right/eap0"}, "7: right has no Secure ADS; expected secure_ads at station"),
    ],
)
def test_invalid_secure_ads_is_a_finding(tmp_path: Path, parts, expected: str) -> None:
    assert any(each.startswith(expected) for each in findings(tmp_path, **parts)), findings(
        tmp_path, **parts
    )


def test_station_without_certificate_needs_one_for_its_route(tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    text = PLANT.format(left=OWN, right="", where="10.0.0.2", tls=f"fingerprint: {PRINT}")
    file.write_text("".join(line for line in text.splitlines(True) if "secure_ads" not in line))
    (finding,) = load(file, lambda path: ExpectedBus()).findings
    assert "route 'right' shows no certificate, which the far end wants" in str(finding)


def test_two_listeners_at_one_address_are_a_finding(tmp_path: Path) -> None:
    (tmp_path / "pem").touch()
    file = tmp_path / "plant.yaml"
    text = PLANT.format(
        left=OWN, right=f"secure_ads: {{{OWN}}}", where="10.0.0.9", tls=f"fingerprint: {PRINT}"
    )
    file.write_text(text.replace("udp://10.0.0.2", "udp://10.0.0.1:5000"))
    (finding,) = load(file, lambda path: ExpectedBus()).findings
    assert "Secure ADS of right and left is at 10.0.0.1:8016" in str(finding)


def test_broker_has_no_fingerprint(tmp_path: Path) -> None:
    (tmp_path / "pem").touch()
    file = tmp_path / "plant.yaml"
    broker = f"{{mqtt: 'mqtts://b', network: line, tls: {{fingerprint: {PRINT}}}}}"
    text = PLANT.format(
        left=OWN, right=f"routes: [{broker}]", where="h", tls=f"fingerprint: {PRINT}"
    )
    file.write_text(text)
    (finding,) = load(file, lambda path: ExpectedBus()).findings
    assert "fingerprint does not belong to a broker" in str(finding)


@pytest.mark.skipif(sys.version_info >= (3, 13), reason="this Python has pre-shared keys")
def test_python_without_pre_shared_keys_says_so(tmp_path: Path) -> None:
    for parts in (
        {"left": f"{OWN}, psk: {{panel: pem}}"},
        {"tls": "identity: me, password_file: pem"},
    ):
        (finding,) = findings(tmp_path, **parts)
        assert "has no pre-shared keys; expected Python 3.13 or newer, or certificates" in finding


def test_rule_may_name_a_client(tmp_path: Path) -> None:
    right = "access: [{allow: [write], transports: ['ams-tls:panel']}]"
    assert findings(tmp_path, right=right) == []
    right = "access: [{allow: [write], transports: ['ams-tls:']}]"
    assert "no transport 'ams-tls:'" in findings(tmp_path, right=right)[0]
