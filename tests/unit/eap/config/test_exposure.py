"""Places that a plant file leaves open: each rule once, none in a plant that is closed."""

from __future__ import annotations

import pytest

from eap.config.load import load
from eap.ops.check import check_file
from tests.support.pages import ROOT
from tests.support.passwords import HASH

OPEN = f"""\
plant: cell
stations:
  - name: press
    net_id: 10.0.0.1.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://10.0.0.1", net_id: 10.0.0.1.2.1}}
      - {{name: eap1, kind: eap, interface: "udp://0.0.0.0:34981", net_id: 10.0.0.1.2.2}}
    variables: {{b: INT}}
    users: [{{name: me, password_file: word}}]
    access:
      - {{name: tools, allow: [write], net_ids: [10.0.7.20.1.1]}}
      - {{name: all, allow: [control]}}
      - {{name: known, allow: [raw], from: [10.0.0.7], transports: ["udp:eap0"]}}
    routes: [{{mqtt: "mqtt://10.0.0.9", network: works}}]
    subscribe:
      - {{name: state, port: eap0, from: {{publisher: 10.0.0.2.2.1, id: 1}}, foreign: true,
         source: any, variables: {{a: INT}}}}
web:
  listen: 10.0.0.1:8080
  anonymous: viewer
  users: [{{name: me, password: '{HASH}'}}]
  tls: {{certificate: word, key: word}}
opcua: {{listen: "10.0.0.1:4840", anonymous: viewer, security: [None], clients: any}}
modbus: {{server: {{listen: "10.0.0.1:502", holding: [press/b]}}}}
mqtt: mqtt://10.0.0.9
"""
FOUND = [
    (1, "CR 2.10", "changes that cannot be recorded are made all the same"),
    (3, "CR 1.2", "press learns routes from every router that answers or announces itself"),
    (7, "CR 5.1", "press/eap1 serves all networks of the host"),
    (9, "CR 1.5", "other hosts add routes to press by a password that crosses the network"),
    (9, "CR 1.5", "others of this host may read word"),
    (10, "CR 2.1", "press lets every host that reaches eap0, eap1 read all variables"),
    (11, "CR 2.1", "rule tools of press lets writing requests through by its source NetID alone"),
    (12, "CR 2.1", "rule all of press lets writing requests through of every host"),
    (13, "CR 2.1", "rule known of press lets writing requests through by datagrams"),
    (14, "CR 1.2", "press's broker mqtt://10.0.0.9 requires no login"),
    (14, "CR 4.1", "press's broker mqtt://10.0.0.9 is reached without encryption"),
    (17, "CR 3.1", "press takes state from any address"),
    (16, "CR 3.1 RE 1", "press takes state without a signature"),
    (20, "CR 1.1", "browsers without a login are viewer"),
    (22, "CR 1.5", "others of this host may read word"),
    (23, "CR 4.1", "the OPC UA server takes channels that are neither signed nor encrypted"),
    (23, "CR 1.1", "OPC UA clients without a login are viewer"),
    (23, "CR 1.9", "OPC UA clients need no certificate that is known"),
    (24, "CR 1.1", "the Modbus server is reached by every host"),
    (25, "CR 1.2", "the broker of values mqtt://10.0.0.9 requires no login"),
    (25, "CR 4.1", "the broker of values mqtt://10.0.0.9 is reached without encryption"),
]

CLOSED = """\
plant: cell
users: [{name: panel, role: operator, from: [10.0.0.30]}]
access: {audit: required}
stations:
  - name: press
    net_id: 10.0.0.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://10.0.0.1", net_id: 10.0.0.1.2.1}
    variables: {b: INT}
    pd_keys: keys
    learn: false
    access:
      - {name: tools, allow: [write], from: [10.0.0.7], transports: [ams-tcp]}
      - {name: panels, allow: [write], roles: [operator], transports: [ams-tcp]}
      - {name: rest, deny: [all], transports: [ams-tcp, udp, tcp, ethernet, mqtt]}
    subscribe:
      - {name: state, port: eap0, from: {publisher: 10.0.0.2.2.1, id: 1}, foreign: true,
         auth: required, variables: {a: INT}}
web: 127.0.0.1:8080
opcua: 127.0.0.1:4840
modbus: {server: {holding: [press/b]}}
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "word").write_text("secret")
    (tmp_path / "word").chmod(0o644)
    keys = tmp_path / "keys"
    keys.write_text("1 " + "ab" * 32)
    keys.chmod(0o600)
    return tmp_path


def found_in(folder, text):
    path = folder / "plant.yaml"
    path.write_text(text)
    result = load(path, pytest.fail)
    assert result.findings == ()
    return result.exposures


def test_each_open_place_is_named_with_its_line_and_requirement(folder):
    found = [(each.line, each.requirement, each.message) for each in found_in(folder, OPEN)]
    assert len(found) == len(FOUND)
    for line, requirement, message in FOUND:
        assert any(
            (line, requirement) == each[:2] and each[2].startswith(message) for each in found
        ), (line, message, found)


def test_closed_plant_has_nothing_open(folder):
    assert found_in(folder, CLOSED) == ()


@pytest.mark.parametrize("name", ["demo", "solar-line", "valve"])
def test_plants_for_this_host_alone_leave_only_the_audit_open(name):
    checked = check_file(ROOT / "config" / f"{name}.yaml", security=True)
    assert [each.requirement for each in checked.report.security] == ["CR 2.10"]
