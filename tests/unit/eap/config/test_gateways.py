from __future__ import annotations

import pytest

from eap.pd.spec import GatewayAddress

SAID = "{silent: true, answer_ms: 50, addresses: {0x9000: valves, 9: right/bus0/valves, 0xA: [9]}}"


def test_gateway_specification_has_all_keys(load_plant):
    loaded = load_plant(with_gateway(SAID, bus(1)), (OTHER, OTHER + bus(0, station=2)))
    left, right = loaded.plant.stations
    _, first, second = left.ports
    assert first.gateway.silent
    assert first.gateway.answer_ms == 50
    assert first.gateway.addresses == (
        GatewayAddress(0x9000, station=1001),
        GatewayAddress(9, net_id="127.0.9.2.3.1", port=1001, name="right/bus0/valves"),
        GatewayAddress(0xA, members=(9,)),
    )
    assert (first.gateway.port, second.gateway.port) == (0, 34981)
    assert left.ports[0].gateway is None
    assert right.ports[1].gateway.enabled


def test_a_master_is_a_bus_port_without_a_slave(load_plant):
    loaded = load_plant(with_gateway("{addresses: {9: left/bus0}}"))
    (found,) = loaded.plant.stations[0].ports[1].gateway.addresses
    assert found == GatewayAddress(9, net_id="127.0.9.1.3.1", port=0xFFFF, name="left/bus0")


PORT = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
OTHER = '"udp://127.0.9.2", net_id: 127.0.9.2.2.1}'


def bus(number, gateway="", station=1, interface="sim://line.yaml"):
    more = f", gateway: {gateway}" if gateway else ""
    net_id = f"127.0.9.{station}.{number + 3}.1"
    port = f"name: bus{number}, kind: bus, interface: {interface}, net_id: {net_id}{more}"
    return f"\n      - {{{port}}}"


def with_gateway(gateway, *more):
    return PORT, PORT + bus(0, gateway) + "".join(more)


@pytest.mark.parametrize(
    "gateway",
    [
        "false",
        "{enabled: true, answer_ms: 50, silent: true, full: true, padded: true}",
        "{addresses: {0x9000: 1001, 9: valves, 10: left/bus0/valves, 11: [1001, valves, 0x9000]}}",
        "{addresses: {1001: 1001, 12: right/bus0/1001, 13: right/bus0, 14: [12, 13]}}",
        "{limits: {in_flight: 4, rate: 100, clients: 8}, port: 40000}",
    ],
)
def test_valid_gateways_have_no_findings(findings, gateway):
    assert findings(with_gateway(gateway), (OTHER, OTHER + bus(0, station=2))) == []


@pytest.mark.parametrize(
    ("gateway", "finding"),
    [
        ("{addresses: {0: 1001}}", "gateway address '0'; a mailbox address from 1 to 0xFFFE"),
        ("{addresses: {0xFFFF: 1001}}", "gateway address '0xFFFF'"),
        ("{addresses: {drive: 1001}}", "gateway address 'drive'"),
        ("{addresses: {0x10: 1001, 16: 1001}}", "gateway address 16 is a duplicate of 0x10"),
        ("{addresses: {0x83E9: 1001}}", "gateway address 0x83E9 is that of slave 1001 with bit 15"),
        ("{addresses: {9: 1002}}", "left/bus0 has no slave 1002; its last one is 1001"),
        ("{addresses: {9: valve}}", "left/bus0 has no slave 'valve', did you mean valves?"),
        ("{addresses: {9: left/eap0/1001}}", "there is no bus port for 'left/eap0/1001'"),
        ("{addresses: {9: left/bus1/1001}}", "there is no bus port for 'left/bus1/1001', did you"),
        ("{addresses: {9: left/bus0/1001/2}}", "there is no bus port for"),
        ("{addresses: {9: left/bus0/x}}", "left/bus0 has no slave 'x'"),
        ("{addresses: {9: []}}", "a group without addresses"),
        ("{addresses: {9: [1001], 10: [9]}}", "0x0009 is a group itself"),
        ("{addresses: {9: [1001, 1005]}}", "left/bus0 has no slave 1005"),
        ("{answer_ms: 1}", "answer_ms is 1; a whole number of milliseconds from 10 to"),
        ("{limits: {in_flight: 0}}", "in_flight is 0; a whole number"),
        ("{prot: 1}", "unknown key 'prot'"),
        ("{port: 34980}", "the gateway to bus0 is served at 127.0.9.1, port 34980, which belongs"),
        ("{port: 48898}", "the gateway to bus0 is served at 127.0.9.1, port 48898, which belongs"),
    ],
)
def test_each_mistake_is_one_finding(findings, gateway, finding):
    [found] = findings(with_gateway(gateway))
    assert found.startswith(f"7: {finding}")


def test_a_second_bus_has_the_next_port_which_may_be_another_ones(findings):
    second = bus(1)
    assert findings(with_gateway("true", second)) == []
    lodger = OTHER.replace("127.0.9.2", "127.0.9.1:34981", 1)
    found = findings(with_gateway("true", second), (OTHER, lodger))[0]
    assert "served at 127.0.9.1, port 34981, which belongs to right/eap0" in found
    every = OTHER.replace("127.0.9.2", "0.0.0.0:34981", 1)
    found = findings(with_gateway("true", second), (OTHER, every))[0]
    assert "which belongs to right/eap0" in found
    elsewhere = bus(1, "{port: 35001}")
    (only,) = findings(with_gateway("true", elsewhere), (OTHER, lodger))
    assert "does not reach right/eap0" in only  # and nothing of gateways


def test_two_gateways_have_two_ports(findings):
    [found] = findings(with_gateway("{port: 34981}", bus(1)))
    assert "which belongs to the gateway to left/bus0" in found


def test_an_eap_port_has_none(findings):
    [found] = findings((PORT, PORT.replace("}", ", gateway: true}")))
    assert "eap0 is a port of kind eap, gateway belongs to bus ports" in found
