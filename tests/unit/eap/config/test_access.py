from __future__ import annotations

import pytest

from eap.ams.spec import AccessRule, AccessService, AccessTarget, ObjectRange
from eap.config.access import (
    access_rules,
    parse_objects,
    parse_sender,
    parse_services,
    parse_source,
    parse_target,
)
from eap.config.routes import SectionError

LEFT_PORT = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
BUS = "- {name: bus0, kind: bus, interface: sim://line.yaml, net_id: 127.0.9.1.3.1}"
OPEN_BUS = '- {name: bus1, kind: bus, interface: "ethernet://eth9", net_id: 127.0.9.1.4.1}'


@pytest.fixture
def plant(index):
    return index((LEFT_PORT, f"{LEFT_PORT}\n      {BUS}\n      {OPEN_BUS}"))


def test_a_rule_says_what_its_texts_stand_for(index):
    access = (
        "access: [{deny: [write], from: [10.0.0.7/24, 02-00-00-00-00-0A], net_ids: [left],"
        " transports: [mqtt], to: [5.1.2.3:851], objects: [0x6000-0x6FFF]},"
        " {name: rest, allow: [all]}]"
    )
    plant = index((LEFT_PORT, f"{LEFT_PORT}\n    {access}"))
    writes = tuple(each for each in AccessService if each is not AccessService.READ)
    assert list(access_rules(plant, plant.stations["left"], set())) == [
        AccessRule(
            "1",
            allow=False,
            networks=("10.0.0.0/24",),
            macs=("02:00:00:00:00:0a",),
            net_ids=("127.0.9.1",),
            transports=("mqtt",),
            targets=(AccessTarget("5.1.2.3", 851),),
            services=writes,
            objects=(ObjectRange(0x6000, 0x6FFF),),
        ),
        AccessRule("rest"),
    ]


def test_write_is_every_service_but_read():
    assert AccessService.READ not in parse_services(("write",), allows=True)
    assert parse_services(("read", "files", "read"), allows=True) == (
        AccessService.READ,
        AccessService.FILES,
    )
    assert len(parse_services(("read", "write"), allows=False)) == len(AccessService)
    assert parse_services(("read", "all"), allows=True) == ()


@pytest.mark.parametrize(
    ("text", "targets"),
    [
        ("left", [("127.0.9.1", None)]),
        ("left:10000", [("127.0.9.1", 10000)]),
        ("left/eap0", [("127.0.9.1.2.1", None)]),
        ("left/eap0:65535", [("127.0.9.1.2.1", 65535)]),
        ("left/bus0/valves", [("127.0.9.1.3.1", 1001)]),
        ("left/bus0/1001", [("127.0.9.1.3.1", 1001)]),
        ("left/bus1/1007", [("127.0.9.1.4.1", 1007)]),
        ("5.1.2.3", [("5.1.2.3", None)]),
        ("5.1.2.3.4.5:1", [("5.1.2.3.4.5", 1)]),
    ],
)
def test_a_target_is_named_or_numbered(plant, text, targets):
    assert parse_target(plant, text, set()) == [AccessTarget(*each) for each in targets]


def test_a_station_without_a_prefix_is_all_its_net_ids(plant):
    found = parse_target(plant, "left", {"left"})
    assert [each.net_id for each in found] == [
        "127.0.9.1.1.1",
        "127.0.9.1.2.1",
        "127.0.9.1.3.1",
        "127.0.9.1.4.1",
    ]
    assert parse_source(plant, "left", {"left"}) == [each.net_id for each in found]
    assert parse_source(plant, "5.1.2.3.9", {"left"}) == ["5.1.2.3.9"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lefd", "no station 'lefd' in this plant, did you mean left?"),
        ("left/bus", "station left has no port 'bus', did you mean bus1?"),
        ("left/eap0/1001", "left/eap0 has no slaves"),
        ("left/bus0/valve", "bus left/bus0 has no slave 'valve', did you mean valves?"),
        ("left/bus0/1002", "bus left/bus0 has no slave '1002'"),
        ("left:65536", "'65536' is no AMS port"),
        ("left:x", "'x' is no AMS port"),
        ("left:²", "'²' is no AMS port"),
        ("left/bus0/²", "bus left/bus0 has no slave '²'"),
        ("5.1.2", "'5.1.2' is no NetID, nor the first numbers of one"),
        ("5.1.2.256", "'5.1.2.256' is no NetID"),
        ("5.1.2.3.4.5.6", "'5.1.2.3.4.5.6' is no NetID"),
    ],
)
def test_unknown_target_is_refused(plant, text, message):
    with pytest.raises(SectionError) as caught:
        parse_target(plant, text, set())
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    ("text", "objects"),
    [
        ("0x6040", (0x6040, 0x6040)),
        ("6040", (0x6040, 0x6040)),
        ("0x8000:1", (0x8000, 0x8000, 1, 1)),
        ("0x8000:0xFF", (0x8000, 0x8000, 0xFF, 0xFF)),
        ("0x6000-0x6FFF", (0x6000, 0x6FFF)),
        ("6000 - 6fff", (0x6000, 0x6FFF)),
        ("0x8000:10", (0x8000, 0x8000, 0x10, 0x10)),
    ],
)
def test_objects_are_one_or_many(text, objects):
    assert parse_objects(text) == ObjectRange(*objects)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "'' names no objects"),
        ("6040h", "'6040h' names no objects"),
        ("10000", "'10000' names no objects"),
        ("0x6000:1-0x6000:2", "'0x6000:1-0x6000:2' names no objects"),
        ("0x8000:100", "'0x8000:100' names no objects"),
        ("0x6000-0x5000", "'0x6000-0x5000' ends before it begins"),
    ],
)
def test_invalid_object_range_is_refused(text, message):
    with pytest.raises(SectionError, match=message):
        parse_objects(text)


def test_a_sender_is_a_network_or_a_mac_address():
    assert parse_sender("10.0.0.5") == "10.0.0.5/32"
    assert parse_sender("10.1.2.3/8") == "10.0.0.0/8"
    assert parse_sender("02-00-00-00-00-0A") == "02:00:00:00:00:0a"
    with pytest.raises(SectionError, match=r"'10\.0\.0\.0/33' is no IPv4 network"):
        parse_sender("10.0.0.0/33")


def test_right_to_write_is_none_to_configure_and_no_right_to_write_neither():
    assert AccessService.CONFIGURE not in parse_services(("write",), allows=True)
    assert AccessService.CONFIGURE in parse_services(("write",), allows=False)
    assert parse_services(("configure",), allows=True) == (AccessService.CONFIGURE,)


def test_unknown_access_is_refused():
    with pytest.raises(SectionError, match=r"unknown access 'wirte', did you mean write\?"):
        parse_services(("wirte",), allows=True)


PORT = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'


def access(*items, key="access"):
    lines = "".join(f"\n      - {{{item}}}" for item in items)
    return PORT, f"{PORT}\n    {key}:{lines}"


def test_access_rule_with_former_key_doors_names_its_transports(index):
    plant = index((LEFT_PORT, f"{LEFT_PORT}\n    access: [{{deny: [all], doors: [mqtt]}}]"))
    (rule,) = access_rules(plant, plant.stations["left"], set())
    assert rule.transports == ("mqtt",)


@pytest.mark.parametrize(
    ("items", "finding"),
    [
        (
            ["from: [10.0.0.1]"],
            "8: access rule has neither allow nor deny; allow or deny",
        ),
        (["allow: [read], deny: [write]"], "8: access rule has both allow and deny; allow or deny"),
        (["allow: read"], "8: allow is 'read'; a list"),
        (["allow: [raed]"], "8: allow: unknown access 'raed', did you mean read?; one of a"),
        (["deny: [no]"], "8: deny: unknown access 'no'; one of all, read, write, control"),
        (["allow: [all], from: [me]"], "8: from: 'me' is no IPv4 network and no MAC address; a"),
        (["allow: [all], net_ids: [rihgt]"], "8: net_ids: 'rihgt' is no NetID, nor the first num"),
        (["allow: [all], to: [right/eap1]"], "8: to: station right has no port 'eap1', did you me"),
        (["allow: [all], objects: [x]"], "8: objects: 'x' names no objects; INDEX, INDEX:SUB"),
        (["allow: [all], transports: [upd]"], "8: transports: no transport 'upd', did you mean u"),
        (["allow: [all], transports: [mqtt:x]"], "8: transports: no transport 'mqtt:x'"),
        (["allow: [all], doors: [upd]"], "8: doors: no transport 'upd', did you mean udp?; one of"),
        (["allow: [all], transports: [udp], doors: [udp]"],
         "8: access rule has both transports and doors; transports alone; doors is its former "),
        (["name: a, allow: [read], transports: [udp]", "name: a, allow: [all]"],
         "9: access rule 'a' exists already (line 8); a name of its own"),
        (["allow: [all], from: [10.0.0.1], transports: [mqtt]"],
         "8: access rule never matches: clients of mqtt have no such address; a rule that can"),
        (["allow: [all], from: ['02:00:00:00:00:01'], transports: [udp]"],
         "8: access rule never matches: clients of udp have no such address; a rule that can"),
        (["allow: [all], from: ['02:00:00:00:00:0x']"], "8: from: '02:00:00:00:00:0x' is no IPv4"),
        (["allow: [files, raw], objects: [0x6000]"],
         "8: access rule never matches: files, raw does not access objects; a rule that can"),
    ],
)  # fmt: skip
def test_invalid_rule_is_one_finding(findings, items, finding):
    [found] = findings(access(*items))
    assert found.startswith(finding)


NEVER = "9: access rule never applies: the rule in line 8 matches before it; this rule before"


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
        ("deny: [all], transports: [udp, mqtt]", "allow: [all], transports: [udp:eap0]"),
        ("deny: [all], net_ids: [5.1.2.3]", "allow: [all], net_ids: [5.1.2.3.1.1]"),
        ("deny: [all], objects: [0x6000-0x6FFF]", "allow: [read], objects: [0x6040:1]"),
    ],
)
def test_rule_after_one_that_always_matches_is_a_finding(findings, first, second):
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
            "allow: [all], from: [02-00-00-00-00-02], transports: [ethernet]",
        ),
        ("deny: [read], to: ['right:851']", "allow: [read], to: [right]"),
        ("deny: [all], transports: [udp:eap0]", "allow: [all], transports: [udp]"),
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
