from __future__ import annotations

import re
import textwrap

import pytest

from eap.ams.spec import Role
from eap.config.index import ExpectedBus
from eap.config.listen import role_of_anonymous
from eap.config.load import PlantResult, load
from eap.config.opcua import channel_securities
from eap.config.opcua_sections import ChannelSecurity, OpcUaSection
from tests.support.passwords import HASH

PLANT = """\
plant: line
stations:
  - name: mixer
    net_id: 10.0.0.1.1.1
    ports: [{name: eap0, kind: eap, interface: "udp://127.0.0.1", net_id: 10.0.0.1.2.1}]
    variables: {speed: UDINT, setpoint: UINT}
    sources: {speed: {kind: counter}}
"""
USERS = f"users: [{{name: anna, role: operator, password: '{HASH}'}}]"


def result(tmp_path, opcua: str) -> PlantResult:
    file = tmp_path / "plant.yaml"
    file.write_text(PLANT + "opcua:\n" + textwrap.indent(textwrap.dedent(opcua), "  "))
    return load(file, lambda path: ExpectedBus())


@pytest.mark.parametrize(
    "text",
    [
        "listen: 127.0.0.1:4840",
        "operators: [mixer/setpoint, 'mixer/*']",
        "{variables: ['mixer/s*'], ranges: {mixer/speed: {min: 0, max: 10}}}",
        "{listen: '0.0.0.0:4840', anonymous: viewer}",
        f"{{listen: '[::]:4840', security: [Aes256Sha256RsaPss], clients: any, {USERS}}}",
    ],
)
def test_key_is_right(tmp_path, text):
    assert result(tmp_path, text).findings == ()


@pytest.mark.parametrize(
    ("text", "finding"),
    [
        ("listen: localhost:4840", "listen: 'localhost' is not an IP address"),
        (
            "listen: 0.0.0.0:4840",
            "listen: 0.0.0.0:4840 is reached by other hosts, and there are no",
        ),
        (
            "{listen: '0.0.0.0:4840', anonymous: operator}",
            "anonymous: every host would be operator without a password",
        ),
        ("variables: [mixer/sped]", "station mixer has no variable 'sped', did you mean speed?"),
        ("operators: [mixer/speed]", "variable mixer/speed cannot be set: it has a source"),
        ("operators: [mixer/x*]", "no variable fits 'mixer/x*'"),
        (
            "ranges: {mixer/speed: {min: 3, max: 3}}",
            "range of mixer/speed: min 3 is not below max 3",
        ),
        ("ranges: {mixer/fast: {min: 0, max: 3}}", "station mixer has no variable 'fast'"),
        ("certificate: own.pem", "certificate and key are not both there"),
        ("{certificate: own.pem, key: own.key}", "own.pem"),
        ("users: [{name: anna, password: secret}]", "the password is no hash of scrypt"),
        ("security: [Basic128Rsa15]", "Basic128Rsa15"),
        ("period_ms: 5", "period_ms"),
    ],
)
def test_invalid_key_is_reported(tmp_path, text, finding):
    found = [
        re.sub(r"^.*?plant.yaml:\d+: ", "", str(each)) for each in result(tmp_path, text).findings
    ]
    assert len([each for each in found if finding in each]) == 1, found


def test_server_without_security_for_other_hosts_is_warned_of(tmp_path):
    found = result(tmp_path, f"{{listen: '0.0.0.0:4840', security: [None], {USERS}}}")
    assert ["security None" in str(each) for each in found.warnings] == [True]


def test_paths_are_from_the_plant_file_on(tmp_path):
    for name in ("own.pem", "own.key"):
        (tmp_path / name).touch()
    plant = result(tmp_path, "{certificate: own.pem, key: own.key}").plant
    assert plant is not None
    section = plant.bridges["opcua"]
    assert isinstance(section, OpcUaSection)
    assert section.certificate == str(tmp_path / "own.pem")


def test_server_of_this_host_alone_offers_channels_without_security():
    assert channel_securities(OpcUaSection()) == tuple(ChannelSecurity)
    remote = OpcUaSection(listen="10.0.0.5:4840")
    assert ChannelSecurity.NONE not in channel_securities(remote)
    only = OpcUaSection(security=(ChannelSecurity.NONE,))
    assert channel_securities(only) == (ChannelSecurity.NONE,)


def test_anonymous_clients_are_engineers_only_without_users():
    assert role_of_anonymous(OpcUaSection()) is Role.ENGINEER
    assert role_of_anonymous(OpcUaSection(anonymous=Role.VIEWER)) is Role.VIEWER
