from __future__ import annotations

from contextlib import suppress
from xml.etree import ElementTree as ET

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.staticroutes import MAX_ROUTES, StaticBroker, StaticRoute, dump, parse

# As the .NET router's description and as users of TwinCAT show them.
FILE = """\
<?xml version="1.0" encoding="utf-8"?>
<TcConfig xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"
          xsi:noNamespaceSchemaLocation="C:\\TwinCAT3\\Config\\TcConfig.xsd">
  <Local>
    <Name>MyLocalSystem</Name>
    <NetId>192.168.1.20.1.1</NetId> <!-- Local NetId -->
    <TcpPort>48898</TcpPort>
  </Local>
  <RemoteConnections>
    <Route>
      <Name>press</Name>
      <Address> press.hall </Address> <!-- host name -->
      <NetId>192.168.1.21.1.1</NetId>
      <Type>TCP_IP</Type>
      <Timeout>5</Timeout>
      <Flags>64</Flags>
    </Route>
    <Mqtt><Address Port="1884">broker</Address><Topic>line</Topic></Mqtt>
    <Mqtt Unidirectional="true"><Address>broker.hall</Address><Topic>hall</Topic><User>me</User>
      <Tls><Ca>ca.crt</Ca><Cert>a.crt</Cert><Key>secret-1</Key><KeyPwd>secret-2</KeyPwd></Tls></Mqtt>
    <Mqtt><Address Port="8884">other</Address><Topic>other</Topic>
      <Psk><Identity>me</Identity><Pwd>secret-3</Pwd></Psk></Mqtt>
    <Json><Address>web</Address></Json>
    <Route>
      <Name>old</Name>
      <NetId>5.1.2.3.1.1</NetId>
      <Type>PROFIBUS</Type>
    </Route>
    <Route Unidirectional="true"><Name>safe</Name><Address>1.2.3.4</Address>
      <NetId>1.2.3.4.1.1</NetId><Type>TCP_IP</Type>
      <Tls IgnoreCn="true"><Ca>c</Ca><Key>secret-4</Key></Tls></Route>
    <Route/>
  </RemoteConnections>
</TcConfig>
"""
PRESS = StaticRoute("press", "192.168.1.21.1.1", "press.hall", flags="64", timeout="5")
SAFE = StaticRoute(
    "safe", "1.2.3.4.1.1", "1.2.3.4",
    is_unidirectional=True, security="Tls", has_ca=True, ignores_name=True,
)  # fmt: skip
BROKERS = [
    StaticBroker("broker", 1884, "line"),
    StaticBroker(
        "broker.hall", 8883, "hall", "me", "ca.crt", "a.crt",
        has_tls=True, has_secret=True, is_unidirectional=True,
    ),
    StaticBroker("other", 8884, "other", has_psk=True, has_secret=True),
]  # fmt: skip
BROKER_WITHOUT_PORT = """\
<TcConfig><RemoteConnections>
<Mqtt><Address Port="x">a</Address></Mqtt></RemoteConnections></TcConfig>
"""
NAMES = st.text(st.characters(codec="utf-8", exclude_categories=("C", "Z")), max_size=20)


def test_routes_are_read_in_their_order_as_they_stand() -> None:
    old = StaticRoute("old", "5.1.2.3.1.1", "", "PROFIBUS")
    assert parse(FILE.encode()).routes == [PRESS, old, SAFE, StaticRoute("", "", "")]


def test_brokers_are_read_without_their_secrets() -> None:
    found = parse(FILE.encode())
    assert found.brokers == BROKERS
    assert found.others == ["Json"]
    assert "secret-" not in repr(found)


def test_brokers_are_written_without_secrets() -> None:
    written = parse(dump("here", "1.1.1.1.1.1", [SAFE], BROKERS, tcp_port=48898))
    assert written.routes == [SAFE._replace(security="", has_ca=False, ignores_name=False)]
    assert written.brokers == [
        BROKERS[0],
        BROKERS[1]._replace(has_secret=False),
        BROKERS[2]._replace(has_psk=False, has_secret=False),
    ]


def test_byte_order_mark_and_other_encodings_are_read() -> None:
    assert parse(FILE.replace("utf-8", "utf-16").encode("utf-16")).routes[0] == PRESS
    assert parse(b"\xef\xbb\xbf" + FILE.encode()).routes[0] == PRESS


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "not XML that can be read"),
        ("<TcConfig>", "line 1: not XML that can be read"),
        ('<?xml version="1.0" encoding="none"?><TcConfig/>', "not XML that can be read"),
        ("<Routes/>", "it begins with 'Routes', expected TcConfig"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><TcConfig>&a;</TcConfig>', "it declares entities"),
        (
            BROKER_WITHOUT_PORT,
            "line 2: Address Port is 'x', expected a whole number from 1 to 65535",
        ),
        (
            "<TcConfig><RemoteConnections>"
            + "<Route/>" * (MAX_ROUTES + 1)
            + "</RemoteConnections></TcConfig>",
            "10001 routes, expected at most 10000",
        ),
    ],
)
def test_other_files_are_refused(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse(text.encode())


ROUTES = st.builds(
    StaticRoute,
    *(NAMES, NAMES, NAMES, st.just("TCP_IP"), NAMES, NAMES, st.booleans()),
    *(st.just(""), st.just(False), st.just(False)),
)


@given(st.lists(ROUTES, max_size=4))
def test_static_routes_round_trip(routes: list[StaticRoute]) -> None:
    assert parse(dump("here <&>", "1.1.1.1.1.1", routes, tcp_port=48898)).routes == routes


def test_file_describes_its_own_router() -> None:
    root = ET.fromstring(dump("a&b", "1.2.3.4.1.1", [PRESS], tcp_port=48898))
    assert [root.findtext(f"Local/{tag}") for tag in ("Name", "NetId", "TcpPort")] == [
        "a&b", "1.2.3.4.1.1", "48898"
    ]  # fmt: skip
    (route,) = root.iterfind("RemoteConnections/Route")
    assert [(each.tag, each.text) for each in route] == [
        ("Name", "press"), ("Address", "press.hall"), ("NetId", "192.168.1.21.1.1"),
        ("Type", "TCP_IP"), ("Flags", "64"), ("Timeout", "5"),
    ]  # fmt: skip


@given(st.binary(max_size=200))
def test_any_octets_are_read_or_refused(octets: bytes) -> None:
    with suppress(ValueError):
        parse(octets)
