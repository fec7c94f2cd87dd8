from __future__ import annotations

from ipaddress import IPv4Address

import pytest

from eap.ads.request import (
    DeleteNotification,
    Operation,
    Read,
    ReadDeviceInfo,
    ReadState,
    ReadWrite,
    Write,
    WriteControl,
)
from eap.ams.access import AccessList, Grants, address_of, host_of, objects_of, service_of
from eap.ams.spec import AccessRule, AccessTarget, ObjectRange, Role
from eap.ams.spec import AccessService as Service
from eap.codec.ads import IndexGroup
from eap.codec.adsnotification import AddNotification
from eap.ids import Endpoint, NetId

G = IndexGroup
SLAVE = NetId.parse("5.1.1.1.3.1"), 1001
ENGINEER = NetId.parse("192.168.0.9.1.1")
READ = Read(G.SDO, 0x1018_0001, 4)
WRITE = Write(G.SDO, 0x8000_0001, bytes(4))
WHOLE = Write(G.SDO, 0x8000_0100, bytes(6))
CONTROL = WriteControl(5, 0, b"")
LAPTOP = Endpoint("ams-tcp", "10.0.0.5:49152")


def grants(*rules: AccessRule, endpoint: Endpoint = LAPTOP, source: NetId = ENGINEER) -> Grants:
    return AccessList(rules).grants(endpoint, source, *SLAVE)


@pytest.mark.parametrize(
    ("operation", "service"),
    [
        (ReadDeviceInfo(), "read"),
        (ReadState(), "read"),
        (READ, "read"),
        (Read(G.RAW_COMMAND, 0, 4), "read"),
        (Write(G.VOE, 0, b"x"), "raw"),
        (WRITE, "write"),
        (Write(G.RELEASE_HANDLE, 0, bytes(4)), "read"),
        (Write(G.FOE_CLOSE, 7, b""), "read"),
        (Write(G.FOE_WRITE, 7, b"x"), "files"),
        (Write(G.SLAVE_STATES, 1001, b"\x02\0"), "control"),
        (Write(G.MASTER_STATE, 8, b""), "control"),
        (ReadWrite(G.SYMBOL_HANDLE, 0, 4, b"x"), "read"),
        (ReadWrite(G.VALUE_BY_NAME, 0, 4, b"x"), "read"),
        (ReadWrite(G.FOE_OPEN_READ, 0, 4, b"x"), "read"),
        (ReadWrite(G.FOE_OPEN_WRITE, 0, 4, b"x"), "files"),
        (ReadWrite(G.SDO, 0, 4, b""), "write"),
        (ReadWrite(G.RELEASE_HANDLE, 0, 4, b""), "write"),
        (ReadWrite(G.RAW_COMMAND, 0, 16, bytes(16)), "raw"),
        (ReadWrite(G.VOE, 0, 16, bytes(16)), "raw"),
        (ReadWrite(G.SUM_READ, 0, 16, bytes(16)), "raw"),
        (CONTROL, "control"),
        (AddNotification(1, 2, 3, 4, 5, 6), "read"),
        (DeleteNotification(1), "read"),
    ],
)
def test_service_of_operations(operation: Operation, service: str) -> None:
    assert service_of(operation) == service


def test_objects_of_operations() -> None:
    assert objects_of(WRITE) == ObjectRange(0x8000, 0x8000, 1, 1)
    assert objects_of(Read(G.SDO, 0x1018_0201, 4)) == ObjectRange(0x1018, 0x1018, 1, 1)
    assert objects_of(Read(G.SDO, 0x1018_8001, 4)) == ObjectRange(0x1018, 0x1018)
    assert objects_of(WHOLE) == ObjectRange(0x8000, 0x8000, 0, 255)
    assert objects_of(Read(G.OBJECT_DESCRIPTION, 0x8000_0000, 64)) == ObjectRange(0x8000, 0x8000)
    assert objects_of(Read(G.ENTRY_DESCRIPTION, 0x8000_0F02, 64)) == ObjectRange(
        0x8000, 0x8000, 2, 2
    )
    assert objects_of(AddNotification(G.SDO, 0x6041_0000, 2, 3, 0, 0)) == ObjectRange(
        0x6041, 0x6041, 0, 0
    )
    assert objects_of(Read(G.OBJECT_LIST, 0x0001_0000, 64)) is None
    assert objects_of(CONTROL) is None


def test_host_of_endpoint() -> None:
    assert host_of(Endpoint("ams-tcp", "10.0.0.2:40000#7")) == "10.0.0.2"
    assert host_of(Endpoint("ethernet:eap0", "02:00:00:00:00:01")) == "02:00:00:00:00:01"
    assert host_of(Endpoint("mqtt:line", "5.1.1.1.1.1")) == "5.1.1.1.1.1"
    assert not host_of(Endpoint("local", "17"))


def test_without_rules_this_host_does_everything_and_others_read() -> None:
    here = grants(endpoint=Endpoint("ams-tcp", "127.0.0.1:40000"))
    assert all(here.decide(each).is_allowed for each in (READ, WRITE, CONTROL))
    others = grants()
    assert others.decide(READ)[:3] == (Service.READ, True, "no rule refuses reading")
    refused = others.decide(WRITE)
    assert refused[:3] == (Service.WRITE, False, "no rule allows it, and other hosts only read")
    assert others.may_read
    assert others.may(Service.WRITE) is False
    assert here.may(Service.RAW) is True


@pytest.mark.parametrize(
    ("endpoint", "here"),
    [
        (Endpoint("local", ""), True),
        (Endpoint("ams-tcp", "127.0.1.1:40000"), True),
        (Endpoint("ams-tcp", "10.0.0.1:40000"), True),
        (Endpoint("ams-tcp:plc", "127.0.1.2:48898"), True),
        (Endpoint("udp:eap0", "127.0.1.2:34980"), True),
        (Endpoint("tcp:eap0", "10.0.0.1:34980"), True),
        (Endpoint("udp:eap0", "10.0.0.2:34980"), False),
        (Endpoint("ams-tcp", "10.0.0.2:40000"), False),
        (Endpoint("ethernet:eap0", "02:00:00:00:00:01"), False),
        (Endpoint("mqtt:line", "127.0.1.1.1.1"), False),
    ],
)
def test_access_list_recognizes_this_host(endpoint: Endpoint, *, here: bool) -> None:
    access = AccessList(own=[IPv4Address("10.0.0.1")])
    assert access.is_this_host(endpoint) is here


def test_address_of_endpoint() -> None:
    assert address_of(Endpoint("udp:eap0", "10.0.0.2:34980")) == IPv4Address("10.0.0.2")
    assert address_of(Endpoint("tcp:eap0", "nobody")) is None
    assert address_of(Endpoint("mqtt:line", "10.0.0.2")) is None


def test_first_rule_that_fits_counts() -> None:
    both = grants(
        AccessRule("not-the-axis", allow=False, objects=(ObjectRange(0x8000, 0x8000),)),
        AccessRule("engineering", services=(Service.WRITE,)),
    )
    refused = both.decide(WRITE)
    assert refused[:4] == (Service.WRITE, False, "rule not-the-axis refuses it", True)
    assert both.decide(Write(G.SDO, 0x8001_0001, b"")).why == "rule engineering allows it"
    assert not both.decide(CONTROL).is_allowed
    assert both.may(Service.WRITE) is None
    assert both.may(Service.CONTROL) is False


def test_one_object_range_is_opened_for_one_network() -> None:
    rule = AccessRule(
        "drives",
        networks=("10.0.0.0/24",),
        services=(Service.WRITE,),
        objects=(ObjectRange(0x8000, 0x8FFF, 1, 1),),
    )
    near, far = grants(rule), grants(rule, endpoint=Endpoint("ams-tcp", "10.0.1.5:1"))
    assert near.decide(WRITE).is_allowed
    assert not near.decide(Write(G.SDO, 0x9000_0001, b"")).is_allowed
    assert not near.decide(WHOLE).is_allowed, "complete access writes more than the rule opens"
    assert not near.decide(Write(G.DATA, 0, b"")).is_allowed
    assert not far.decide(WRITE).is_allowed


def test_a_refusal_of_an_entry_refuses_complete_access_to_its_object() -> None:
    rule = AccessRule("secret", allow=False, objects=(ObjectRange(0x1018, 0x1018, 4, 4),))
    hidden = grants(rule)
    assert hidden.decide(READ).is_allowed
    assert not hidden.decide(Read(G.SDO, 0x1018_0004, 4)).is_allowed
    assert not hidden.decide(Read(G.SDO, 0x1018_0100, 64)).is_allowed
    assert not hidden.may_read


def test_rules_may_lock_this_host_out() -> None:
    rule = AccessRule("nobody-here", allow=False, transports=("local", "ams-tcp"))
    here = grants(rule, endpoint=Endpoint("ams-tcp", "127.0.0.1:1"))
    assert not here.decide(READ).is_allowed
    assert grants(rule, endpoint=Endpoint("udp:eap0", "127.0.1.1:1")).decide(WRITE).is_allowed


@pytest.mark.parametrize(
    ("rule", "fits"),
    [
        (AccessRule("r", net_ids=("192.168.0.9.1.1",)), True),
        (AccessRule("r", net_ids=("192.168.0.9",)), True),
        (AccessRule("r", net_ids=("192.168.0.8", "192.168.0.7")), False),
        (AccessRule("r", transports=("mqtt:line",)), False),
        (AccessRule("r", transports=("ams-tcp",)), True),
        (AccessRule("r", targets=(AccessTarget("5.1.1.1"),)), True),
        (AccessRule("r", targets=(AccessTarget("5.1.1.1.3.1", 1001),)), True),
        (AccessRule("r", targets=(AccessTarget("5.1.1.1.3.1", 1002),)), False),
        (AccessRule("r", targets=(AccessTarget("5.1.1.1.2.1"),)), False),
        (AccessRule("r", networks=("10.0.0.0/8",), net_ids=("1.2.3.4",)), False),
    ],
)
def test_every_condition_of_a_rule_has_to_fit(rule: AccessRule, *, fits: bool) -> None:
    assert grants(rule).decide(WRITE).is_allowed is fits


def test_rule_with_network_does_not_fit_transports_without_addresses() -> None:
    rule = AccessRule("all", networks=("0.0.0.0/0",))
    assert (
        not grants(rule, endpoint=Endpoint("ethernet:eap0", "02:00:00:00:00:01"))
        .decide(WRITE)
        .is_allowed
    )


def test_access_list_cache_is_bounded() -> None:
    access = AccessList()
    first = access.grants(LAPTOP, ENGINEER, *SLAVE)
    assert access.grants(LAPTOP, ENGINEER, *SLAVE) is first
    for port in range(5000):
        access.grants(LAPTOP, ENGINEER, SLAVE[0], port)
    assert access.grants(LAPTOP, ENGINEER, *SLAVE) is not first


@pytest.mark.parametrize(
    ("transport", "connection", "fits"),
    [
        ("ethernet:eap0", "02:00:00:00:00:0a", True),
        ("ethernet:eap0", "02:00:00:00:00:0b", False),
        ("udp:eap0", "10.0.0.5:34980", True),
        ("udp:eap0", "10.0.0.6:34980", False),
        ("mqtt:line", "5.1.2.3.1.1", False),
    ],
)
def test_senders_on_ethernet_have_mac_addresses(transport, connection, fits) -> None:
    rule = AccessRule("x", networks=("10.0.0.5/32",), macs=("02-00-00-00-00-0A",))
    assert grants(rule, endpoint=Endpoint(transport, connection)).decide(WRITE).is_allowed is fits
    only = AccessRule("x", networks=("0.0.0.0/0",))
    assert (
        not grants(only, endpoint=Endpoint("ethernet:eap0", "02:00:00:00:00:0a"))
        .decide(WRITE)
        .is_allowed
    )


@pytest.mark.parametrize(
    ("endpoint", "role", "fits"),
    [
        (LAPTOP, None, True),
        (Endpoint("ams-tcp", "10.0.0.6:49152"), None, False),
        (Endpoint("ethernet:eap1", "02:00:00:00:00:0a"), None, True),
        (Endpoint("ethernet:eap1", "02:00:00:00:00:0b"), None, False),
        (Endpoint("mqtt:line", "5.1.1.1.1.1"), None, True),
        (Endpoint("mqtt:lines", "5.1.1.1.1.1"), None, False),
        (Endpoint("ams-tls:panel", "10.9.9.9:4711#1"), None, True),
        (Endpoint("ams-tls:panel-2", "10.9.9.9:4711#2"), None, False),
        (Endpoint("ams-tcp", "10.9.9.9:4711#3"), None, False),
        (Endpoint("web", "10.0.0.6"), Role.OPERATOR, True),
        (Endpoint("web", "10.0.0.5"), Role.VIEWER, False),
    ],
)
def test_rule_with_roles_fits_logged_in_users_by_role_and_others_by_address(endpoint, role, fits):
    members = ("10.0.0.5/32", "02:00:00:00:00:0a", "mqtt:line", "ams-tls:panel")
    rule = AccessRule("r", roles=(Role.OPERATOR,), members=members)
    found = AccessList([rule]).grants(endpoint, ENGINEER, *SLAVE, role)
    assert found.decide(WRITE).is_allowed is fits
