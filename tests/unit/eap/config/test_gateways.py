from __future__ import annotations

from eap.pd.spec import GatewayAddress
from tests.unit.eap.config.test_check_gateways import OTHER, bus, with_gateway

SAID = "{silent: true, answer_ms: 50, addresses: {0x9000: valves, 9: right/bus0/valves, 0xA: [9]}}"


def test_what_a_gateway_is_told(load_plant):
    loaded = load_plant(with_gateway(SAID, bus(1)), (OTHER, OTHER + bus(0, station=2)))
    left, right = loaded.plant.stations
    _, first, second = left.ports
    assert first.gateway.silent
    assert first.gateway.answer_ms == 50
    assert first.gateway.addresses == (
        GatewayAddress(0x9000, station=1001),
        GatewayAddress(9, net_id="127.0.9.2.3.1", port=1001),
        GatewayAddress(0xA, members=(9,)),
    )
    assert (first.gateway.port, second.gateway.port) == (0, 34981)
    assert left.ports[0].gateway is None
    assert right.ports[1].gateway.enabled


def test_a_master_is_a_bus_port_without_a_slave(load_plant):
    loaded = load_plant(with_gateway("{addresses: {9: left/bus0}}"))
    (found,) = loaded.plant.stations[0].ports[1].gateway.addresses
    assert found == GatewayAddress(9, net_id="127.0.9.1.3.1", port=0xFFFF)
