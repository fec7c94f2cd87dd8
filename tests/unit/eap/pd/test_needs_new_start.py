from __future__ import annotations

from msgspec.structs import replace

from eap.pd.handover import needs_new_start
from eap.pd.spec import BusPortSpec, GatewaySpec, PortKind, PortSpec
from tests.unit.eap.appliance.conftest import eap_port, left

END = ": this needs a new start of the appliance"
BUS = PortSpec("bus0", PortKind.BUS, "sim://x.yaml", "1.2.3.4.6.1", bus=BusPortSpec("/x.yaml"))


def test_all_but_ports_may_change():
    assert needs_new_start(left(), left()) == []
    assert needs_new_start(left(), replace(left(), frames=(), variables=(), cycle_us=7)) == []


def test_what_frames_say_of_a_port_may_change():
    port = replace(eap_port(1), net_id="9.9.9.9.1.1", eap_sm=True)
    assert needs_new_start(left(), left(port)) == []


def test_what_was_opened_is_named():
    port = replace(eap_port(1), interface="udp://127.9.2.9", join=("239.1.1.1",), tcp=True)
    assert needs_new_start(left(), left(port)) == [
        f"port eap0: interface udp://127.9.2.1 -> udp://127.9.2.9{END}",
        f"port eap0: join () -> ('239.1.1.1',){END}",
        f"port eap0: tcp False -> True{END}",
    ]


def test_ports_stay_the_same_ones():
    other = replace(left(), name="up", ports=(replace(eap_port(1), name="eap1"), BUS))
    assert needs_new_start(replace(left(), ports=(eap_port(1), BUS)), other) == [
        f"station left cannot become up{END}",
        f"port eap1 is new{END}",
        f"port eap0 is gone{END}",
    ]


def test_a_bus_is_not_written_out():
    before = replace(left(), ports=(BUS,))
    after = replace(left(), ports=(replace(BUS, bus=BusPortSpec("/y.yaml")),))
    assert needs_new_start(before, after) == [f"port bus0: bus is another one{END}"]


def test_nor_is_what_a_gateway_is_told():
    before = replace(left(), ports=(replace(BUS, gateway=GatewaySpec()),))
    after = replace(left(), ports=(replace(BUS, gateway=GatewaySpec(silent=True)),))
    assert needs_new_start(before, after) == [f"port bus0: gateway is another one{END}"]
