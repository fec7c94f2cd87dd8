from __future__ import annotations

import pytest

PORT = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'


def access(*items, key="access"):
    lines = "".join(f"\n      - {{{item}}}" for item in items)
    return PORT, f"{PORT}\n    {key}:{lines}"


@pytest.mark.parametrize(
    ("items", "finding"),
    [
        (["from: [10.0.0.1]"], "8: nothing is said; allow or deny with what it is about, such as"),
        (["allow: [read], deny: [write]"], "8: access rule has both allow and deny; allow or deny"),
        (["allow: read"], "8: allow is 'read'; a list"),
        (["allow: [raed]"], "8: allow: no access is called 'raed', did you mean read?; one of a"),
        (["deny: [no]"], "8: deny: no access is called 'no'; one of all, read, write, control"),
        (["allow: [all], from: [me]"], "8: from: 'me' is no IPv4 network and no MAC address; a"),
        (["allow: [all], net_ids: [rihgt]"], "8: net_ids: 'rihgt' is no NetID, nor the first num"),
        (["allow: [all], to: [right/eap1]"], "8: to: station right has no port 'eap1', did you me"),
        (["allow: [all], objects: [x]"], "8: objects: 'x' names no objects; INDEX, INDEX:SUB"),
        (["allow: [all], doors: [upd]"], "8: doors: no door 'upd', did you mean udp?; one of ud"),
        (["allow: [all], doors: [mqtt:x]"], "8: doors: no door 'mqtt:x'"),
        (["name: a, allow: [read], doors: [udp]", "name: a, allow: [all]"],
         "9: access rule 'a' exists already (line 8); a name of its own"),
        (["allow: [all], from: [10.0.0.1], doors: [mqtt]"],
         "8: access rule can never fit: who comes by mqtt has no such address; a rule that can"),
        (["allow: [all], from: ['02:00:00:00:00:01'], doors: [udp]"],
         "8: access rule can never fit: who comes by udp has no such address; a rule that can"),
        (["allow: [all], from: ['02:00:00:00:00:0x']"], "8: from: '02:00:00:00:00:0x' is no IPv4"),
        (["allow: [files, raw], objects: [0x6000]"],
         "8: access rule can never fit: files, raw is not about objects; a rule that can"),
    ],
)  # fmt: skip
def test_a_rule_that_cannot_be_is_one_finding(findings, items, finding):
    [found] = findings(access(*items))
    assert found.startswith(finding)


NEVER = "9: access rule is never asked: the one of line 8 fits before it; it before that one, or"


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("allow: [all]", "deny: [write], from: [10.0.0.1]"),
        ("allow: [all], from: [10.0.0.0/8]", "deny: [all], from: [10.1.0.0/16, 10.2.0.1]"),
        ("allow: [write]", "deny: [control]"),
        (
            "allow: [all], from: [02-00-00-00-00-01, 10.0.0.1]",
            "deny: [all], from: ['02:00:00:00:00:01']",
        ),
        ("deny: [read], to: [right]", "allow: [read], to: [right/eap0]"),
        ("deny: [read], to: [right]", "allow: [read], to: ['right:851']"),
        ("deny: [all], doors: [udp, mqtt]", "allow: [all], doors: [udp:eap0]"),
        ("deny: [all], net_ids: [5.1.2.3]", "allow: [all], net_ids: [5.1.2.3.1.1]"),
        ("deny: [all], objects: [0x6000-0x6FFF]", "allow: [read], objects: [0x6040:1]"),
    ],
)
def test_a_rule_behind_one_that_always_fits_is_a_finding(findings, first, second):
    [found] = findings(access(first, second))
    assert found.startswith(NEVER)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("deny: [all], from: [10.1.0.0/16]", "allow: [all], from: [10.0.0.0/8]"),
        ("deny: [write]", "allow: [all]"),
        ("deny: [all], from: [10.0.0.1]", "allow: [all], from: [02-00-00-00-00-01]"),
        ("deny: [all], from: [02-00-00-00-00-01]", "allow: [all]"),
        (
            "deny: [all], from: [02-00-00-00-00-01]",
            "allow: [all], from: [02-00-00-00-00-02], doors: [ethernet]",
        ),
        ("deny: [read], to: ['right:851']", "allow: [read], to: [right]"),
        ("deny: [all], doors: [udp:eap0]", "allow: [all], doors: [udp]"),
        ("deny: [all], net_ids: [5.1.2.3]", "allow: [all], net_ids: [5.1.2.30.1.1]"),
        ("deny: [all], objects: [0x6040:1]", "allow: [all], objects: [0x6040]"),
        ("deny: [all], objects: [0x6040]", "allow: [all]"),
    ],
)
def test_a_wider_rule_behind_a_narrower_one_is_no_finding(findings, first, second):
    assert findings(access(first, second)) == []


def test_users_have_names_and_passwords(findings):
    user = "name: a, password_file: line.yaml"
    assert findings(access(user, key="users")) == []
    [twice] = findings(access(user, user, key="users"))
    assert twice.startswith("9: user 'a' exists already (line 8); a name of its own")
    [gone] = findings(access("name: a, password_file: gone", key="users"))
    assert gone.startswith("8: gone: No such file or directory; a file, its path from the plant")
