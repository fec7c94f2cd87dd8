"""Users of the whole plant."""

from __future__ import annotations

import pytest

from eap.ams.spec import AccessRule, Role
from eap.config.index import ExpectedBus
from eap.config.load import Plant, PlantResult, load
from eap.config.opcua_sections import OpcUaSection
from tests.support.passwords import HASH

PLANT = """\
plant: line
stations:
  - name: mixer
    net_id: 10.0.0.1.1.1
    ports: [{name: eap0, kind: eap, interface: "udp://127.0.0.1", net_id: 10.0.0.1.2.1}]
    variables: {setpoint: UINT}
"""
ANNA = f"{{name: anna, role: engineer, password: '{HASH}', unix: [anna], from: [10.0.7.0/24]}}"
OTTO = "{name: otto, role: operator, groups: [shift], from: [02-00-00-00-00-0A, 10.0.8.1]}"


def result(tmp_path, *lines: str) -> PlantResult:
    file = tmp_path / "plant.yaml"
    file.write_text(PLANT + "\n".join(lines) + "\n")
    return load(file, lambda path: ExpectedBus())


def plant(tmp_path, *lines: str) -> Plant:
    found = result(tmp_path, *lines)
    assert found.findings == ()
    assert found.plant is not None
    return found.plant


def test_servers_without_users_have_those_of_the_plant(tmp_path):
    own = f"{{name: otto, password: '{HASH}'}}"
    found = plant(
        tmp_path,
        f"users: [{ANNA}, {OTTO}]",
        "access: {operators: ['mixer/*']}",
        "web: 127.0.0.1:8080",
        f"metrics: {{users: [{own}]}}",
        "opcua: 127.0.0.1:4840",
    )
    assert [each.name for each in found.users] == ["anna", "otto"]
    assert found.web is not None
    assert [each.name for each in found.web.users] == ["anna", "otto"]
    assert found.metrics is not None
    assert [each.name for each in found.metrics.users] == ["otto"]
    opcua = found.bridges["opcua"]
    assert isinstance(opcua, OpcUaSection)
    assert ([each.name for each in opcua.users], opcua.operators) == (
        ["anna", "otto"],
        ("mixer/*",),
    )


def test_rule_with_roles_has_the_addresses_of_their_users(tmp_path):
    both = "{allow: [write], roles: [operator, engineer]}"
    rules = f"    access: [{both}, {{deny: [all], roles: [viewer]}}]"
    found = plant(tmp_path, rules, f"users: [{ANNA}, {OTTO}, {{name: eva, from: [10.0.9.9]}}]")
    both, viewers = found.routing["mixer"].access
    assert both.roles == (Role.OPERATOR, Role.ENGINEER)
    assert both.members == ("10.0.7.0/24", "02:00:00:00:00:0a", "10.0.8.1/32")
    assert viewers == AccessRule("2", allow=False, roles=(Role.VIEWER,), members=("10.0.9.9/32",))


def test_station_takes_engineers_of_the_plant_for_routes(tmp_path):
    found = plant(tmp_path, "    users: [{name: anna}]", f"users: [{ANNA}]")
    assert [each.password_file for each in found.routing["mixer"].users] == [""]


@pytest.mark.parametrize(
    ("lines", "finding"),
    [
        (["users: [{name: anna}]"], "user anna: nothing identifies it; expected password, unix"),
        ([f"users: [{OTTO}, {OTTO}]"], "user otto is there twice"),
        (["users: [{name: anna, password: secret}]"], "user anna: the password is no hash"),
        (["users: [{name: anna, from: [10.0.0.300]}]"], "from: '10.0.0.300' is no IPv4 network"),
        (
            [f"users: [{ANNA}, {{name: eva, from: [10.0.7.9]}}]"],
            "10.0.7.9/32 is viewer, and engineer as 10.0.7.0/24 of anna",
        ),
        (
            ["users: [{name: eva, role: operator, from: [0.0.0.0/0]}]"],
            "every host would be operator",
        ),
        (
            [f"users: [{OTTO}, {{name: eva, from: ['02:00:00:00:00:0a']}}]"],
            "02:00:00:00:00:0a is viewer, and operator",
        ),
        ([f"users: [{ANNA}]", "access: {operators: [mixer/setpont]}"], "did you mean setpoint?"),
        (["access: {operators: [mixer/setpoint]}"], "operators without users: programs of this"),
        (["    access: [{allow: [write], roles: [operator]}]"], "roles: the plant has no users"),
        (
            [
                "    access: [{deny: [all], roles: [viewer]}, {allow: [read], roles: [viewer]}]",
                f"users: [{ANNA}]",
            ],
            "access rule never applies: the rule in line",
        ),
        (
            ["    users: [{name: ana}]", f"users: [{ANNA}]"],
            "user ana is none of the plant's users, did you mean anna?",
        ),
        (["    users: [{name: otto}]", f"users: [{OTTO}]"], "user otto has the role operator"),
        (
            ["    users: [{name: eva}]", "users: [{name: eva, role: engineer, unix: [eva]}]"],
            "user eva has no password",
        ),
    ],
)
def test_finding_names_what_is_wrong(tmp_path, lines, finding):
    assert finding in "\n".join(map(str, result(tmp_path, *lines).findings))
