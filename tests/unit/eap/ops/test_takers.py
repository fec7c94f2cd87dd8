"""Subscriptions compared with a PD on the network: what they drop, and where frames reach them."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from eap.ids import InterfaceUri, NetId
from eap.ops.discover import takers_of
from eap.pd.observer import ObservedPdKey
from eap.pd.spec import RxAlternateSpec, RxPdSpec, SentVariableSpec
from eap.pd.words import PdDropReason
from tests.support.cyclic import PEER, eap_port, received, station

SUBSCRIPTION = RxPdSpec(
    "in",
    "eap0",
    7,
    ("x",),
    PEER,
    version=3,
    alternates=(RxAlternateSpec(4, (SentVariableSpec("", "UINT"), SentVariableSpec("x", "UINT"))),),
)


def taker(interface: str = "udp://10.0.0.1", vlan_id: int = 0, **options: object):
    port = replace(eap_port(), interface=InterfaceUri.parse(interface), vlan_id=vlan_id)
    pd = replace(SUBSCRIPTION, **options)
    spec = station(ports=(port,), variables=received("x:UINT"), subscriptions=(pd,))
    (found,) = takers_of([spec])
    return found


def key(**fields: object) -> ObservedPdKey:
    values = {
        "publisher": NetId.parse(PEER),
        "pd_id": 7,
        "version": 3,
        "length": 2,
        "transport": "udp",
        "destination": "10.0.0.1",
        "vlan_id": None,
    }
    return ObservedPdKey(**values | fields)


@pytest.mark.parametrize(
    ("options", "fields", "reason"),
    [
        ({}, {}, None),
        ({}, {"publisher": NetId.parse("9.9.9.9.9.9")}, PdDropReason.WRONG_PUBLISHER),
        ({"publisher": ""}, {"publisher": NetId.parse("9.9.9.9.9.9")}, None),
        ({}, {"version": 5}, PdDropReason.VERSION),
        ({"ignore_version": True}, {"version": 5}, None),
        ({}, {"length": 3}, PdDropReason.LENGTH),
        ({}, {"version": 4, "length": 4}, None),
    ],
)
def test_refusal_is_that_of_the_subscriber(options, fields, reason):
    assert taker(**options).refusal(key(**fields)) is reason


@pytest.mark.parametrize(
    ("interface", "fields", "reached"),
    [
        ("udp://10.0.0.1", {}, True),
        ("udp://10.0.0.2", {}, False),
        ("udp://0.0.0.0", {}, True),
        ("udp://10.0.0.1:4000", {}, False),
        ("udp://10.0.0.1:4000", {"destination": "10.0.0.1:4000"}, True),
        ("udp://10.0.0.2", {"destination": "239.0.0.1"}, True),
        ("udp://10.0.0.2", {"destination": "255.255.255.255"}, True),
        ("tcp://10.0.0.1", {"transport": "tcp"}, True),
        ("loop://line", {}, False),
        ("ethernet://eth0", {}, False),
        ("ethernet://eth0", {"transport": "ethernet", "destination": "01:01:05:04:00:00"}, True),
        (
            "ethernet://eth0",
            {"transport": "ethernet", "destination": "01:01:05:04:00:00", "vlan_id": 7},
            False,
        ),
        ("udp://10.0.0.1", {"transport": "ethernet", "destination": "01:01:05:04:00:00"}, False),
    ],
)
def test_port_is_reached_by_frames_to_its_address_and_groups(interface, fields, reached):
    assert taker(interface).is_reached(key(**fields)) is reached


def test_name_is_that_of_the_status():
    assert taker().name == "a/in"
