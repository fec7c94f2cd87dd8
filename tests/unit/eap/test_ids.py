from __future__ import annotations

import re

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ids import (
    BROADCAST_MAC,
    EAP_MULTICAST_MAC,
    Destination,
    DestinationKind,
    Endpoint,
    InterfaceUri,
    MacAddr,
    NetId,
    ObjectId,
    decode_value,
    encode_value,
    parse_host,
    prefix_text,
)

six_octets = st.binary(min_size=6, max_size=6)
addresses = st.ip_addresses(v=4).map(str)


class Bound(msgspec.Struct, frozen=True):
    interface: InterfaceUri
    net_id: NetId


@given(six_octets)
def test_net_id_round_trip(octets: bytes) -> None:
    net_id = NetId(octets)
    assert NetId.parse(str(net_id)) == net_id == octets
    assert eval(repr(net_id)) == net_id


@pytest.mark.parametrize(
    "text",
    ["", "1.2.3.4.5", "1.2.3.4.5.6.7", "1.2.3.4.5.256", "1.2.3.4.5.x", "1.2.3.4.5.²", "1..3.4.5.6"],
)
def test_net_id_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"NetID|number above 255"):
        NetId.parse(text)


@given(six_octets)
def test_mac_round_trip(octets: bytes) -> None:
    mac = MacAddr(octets)
    assert MacAddr.parse(str(mac)) == mac == octets
    assert MacAddr.parse(str(mac).upper().replace(":", "-")) == mac
    assert eval(repr(mac)) == mac


@pytest.mark.parametrize("text", ["", "01:02:03:04:05", "01:02:03:04:05:0g", "010203040506"])
def test_wrong_mac_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is not a MAC address"):
        MacAddr.parse(text)


def test_group_addresses_are_known_as_such() -> None:
    assert BROADCAST_MAC.is_group
    assert EAP_MULTICAST_MAC.is_group
    assert not MacAddr.parse("02:01:05:00:00:01").is_group


@pytest.mark.parametrize(
    "text",
    [
        "udp://127.0.1.1",
        "udp://127.0.1.1:40000",
        "tcp://10.0.0.1",
        "ethernet://eth0",
        "loop://line?delay_us=100&loss=0.1",
        "sim://buses/a.yaml",
    ],
)
def test_interface_round_trip(text: str) -> None:
    assert str(InterfaceUri.parse(text)) == text


def test_interface_is_read_by_its_parts() -> None:
    uri = InterfaceUri.parse("udp://127.0.1.1:40000")
    assert (uri.scheme, uri.host, uri.port, uri.options) == ("udp", "127.0.1.1", 40000, ())
    assert uri == InterfaceUri("udp", "127.0.1.1", 40000)
    assert uri != InterfaceUri.parse("udp://127.0.1.1")
    assert InterfaceUri.parse("loop://a?loss=1").options == (("loss", "1"),)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("eth0", "is not an interface"),
        ("http://127.0.0.1", "one of udp://"),
        ("udp://localhost", "'localhost' is not an IPv4 address"),
        ("udp://1.2.3.4:0", "'0' is not a port"),
        ("udp://1.2.3.4:70000", "is not a port"),
        ("ethernet://", "names no interface"),
        ("loop://a?loss", "bad query field"),
    ],
)
def test_wrong_interface_is_refused(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        InterfaceUri.parse(text)


@given(addresses, st.integers(0, 65535), st.booleans())
def test_destination_round_trip(address: str, port: int, tcp: bool) -> None:
    text = ("tcp://" if tcp else "") + address + (f":{port}" if port else "")
    destination = Destination.parse(text)
    assert destination.kind is (DestinationKind.TCP if tcp else DestinationKind.IP)
    assert (destination.host, destination.port) == (address, port)
    assert str(destination) == text


def test_net_ids_of_a_station_have_a_beginning_in_common() -> None:
    station = NetId.parse("5.23.91.23.1.1").station
    assert station == NetId.parse("5.23.91.23.2.1").station
    assert prefix_text(station) == "5.23.91.23.x.x"
    assert prefix_text(NetId.parse("5.23.91.23.1.1")) == "5.23.91.23.1.1"


@pytest.mark.parametrize(
    ("text", "is_group"),
    [
        ("01:01:05:04:00:00", True),
        ("02-01-05-04-00-00", False),
        ("239.1.2.3", True),
        ("255.255.255.255", True),
        ("127.0.1.1", False),
        ("5.23.91.23.1.1", False),
        ("tcp://127.0.1.1", False),
    ],
)
def test_destination_is_known_as_group(text: str, is_group: bool) -> None:
    assert Destination.parse(text).is_group is is_group


def test_destination_may_be_a_net_id() -> None:
    assert Destination.parse("5.023.91.23.1.1") == (DestinationKind.NET_ID, "5.23.91.23.1.1", 0)
    with pytest.raises(ValueError, match="number above 255"):
        Destination.parse("5.23.91.256.1.1")


def test_destination_mac_has_one_spelling() -> None:
    assert Destination.parse("02-01-05-0A-00-00") == (DestinationKind.MAC, "02:01:05:0a:00:00", 0)


@pytest.mark.parametrize(
    "text", ["", "host", "1.2.3", "1.2.3.4:x", "01:02:03:04:05:zz", "tcp://eth0"]
)
def test_wrong_destination_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is not a"):
        Destination.parse(text)


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [
        ("192.168.1.5", "192.168.1.5", 48898),
        ("192.168.1.5:4000", "192.168.1.5", 4000),
        ("plc", "plc", 48898),
        ("plc-3.line_1.example:1", "plc-3.line_1.example", 1),
    ],
)
def test_a_host_has_a_name_or_an_address(text: str, host: str, port: int) -> None:
    assert parse_host(text, 48898) == (host, port)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "'' is no name of a host"),
        ("-a", "'-a' is no name of a host"),
        ("a b", "'a b' is no name of a host"),
        ("a..b", "'a..b' is no name of a host"),
        ("a" * 64, "is no name of a host"),
        (".".join(["abcdefgh"] * 29), "is no name of a host"),
        ("1.2.3", "'1.2.3' is not the IPv4 address of a host"),
        ("1.2.3.256", "'1.2.3.256' is not the IPv4 address of a host"),
        ("239.1.1.1", "is not the IPv4 address of a host"),
        ("0.0.0.0", "is not the IPv4 address of a host"),
        ("255.255.255.255", "is not the IPv4 address of a host"),
        ("plc:0", "'0' is not a port (1 to 65535)"),
        ("plc:65536", "'65536' is not a port (1 to 65535)"),
        ("plc:²", "'²' is not a port (1 to 65535)"),
        ("plc:", "'' is not a port (1 to 65535)"),
        ("::1", "is not a port"),
    ],
)
def test_what_is_no_host_says_why(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=re.escape(reason)):
        parse_host(text, 1)


@given(st.integers(0, 0xFFFF), st.integers(0, 0xFF))
def test_object_id_round_trip(index: int, subindex: int) -> None:
    object_id = ObjectId(index, subindex)
    assert ObjectId.parse(str(object_id)) == object_id == (index, subindex)
    assert ObjectId.parse(f"{index:x}:{subindex:x}") == object_id
    assert ObjectId.parse(f"0x{index:04X}:0x{subindex:02X}") == object_id


@pytest.mark.parametrize(
    ("text", "object_id"),
    [("1000:0", (0x1000, 0)), ("4120", (0x4120, 0)), ("0X1018:10", (0x1018, 16)), ("0", (0, 0))],
)
def test_object_id_without_prefix_is_hexadecimal(text: str, object_id: tuple[int, int]) -> None:
    assert ObjectId.parse(text) == object_id


@pytest.mark.parametrize(
    "text",
    ["", ":1", "x", "0x", "10000", "1018:", "1018:100", "1018:1:2", "-1", " 1018", "1_0", "१:1"],
)
def test_object_id_refused(text: str) -> None:
    with pytest.raises(ValueError, match="such as 0x1018:01"):
        ObjectId.parse(text)


def test_addresses_in_records_are_their_texts() -> None:
    port = Bound(InterfaceUri.parse("udp://127.0.1.1:40000"), NetId.parse("127.0.1.1.2.1"))
    text = msgspec.json.encode(port, enc_hook=encode_value)
    assert text == b'{"interface":"udp://127.0.1.1:40000","net_id":"127.0.1.1.2.1"}'
    assert msgspec.json.decode(text, type=Bound, dec_hook=decode_value) == port


@pytest.mark.parametrize(
    ("key", "text", "reason"),
    [
        ("interface", "serial://a", "is not an interface"),
        ("net_id", "1.2.3", "is not an AMS NetID"),
        ("net_id", 5, r"got `int` - at `\$.net_id`"),
    ],
)
def test_invalid_address_in_record_is_refused_with_its_field(key, text, reason) -> None:
    fields = {"interface": "loop://a", "net_id": "1.1.1.1.1.1"} | {key: text}
    with pytest.raises(msgspec.ValidationError, match=reason):
        msgspec.convert(fields, Bound, dec_hook=decode_value)


def test_endpoint_text_has_connection_and_transport() -> None:
    assert str(Endpoint("AMS/TCP", "10.0.0.1:3456 #7")) == "10.0.0.1:3456 #7 by AMS/TCP"
    assert str(Endpoint("ams-tcp:10.0.0.1:48898", "10.0.0.1:48898")) == "10.0.0.1:48898 by ams-tcp"
