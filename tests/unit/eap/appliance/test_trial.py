from __future__ import annotations

from msgspec.structs import replace

from eap.appliance.trial import why_not_built
from eap.pd.spec import PortKind, PortSpec, RxPdSpec, TxFrameSpec, TxPdSpec
from tests.unit.eap.appliance.conftest import eap_port, left, right

BUS = PortSpec("bus0", PortKind.BUS, "sim://x.yaml", "1.2.3.4.6.1")


def test_whatever_a_plant_file_says_can_be_built():
    for interface in ("udp://127.9.2.1", "ethernet://eth7", "tcp://127.9.2.1"):
        spec = left(eap_port(1, interface))
        assert why_not_built(replace(spec, ports=(*spec.ports, BUS))) == []
    assert why_not_built(right()) == []


def test_what_does_not_fit_together_is_told():
    unknown = replace(right(), subscriptions=(RxPdSpec("a", "eap0", 1, ("nothing",)),))
    assert why_not_built(unknown) == ["it cannot be built: KeyError: 'nothing'"]
    many = tuple(TxPdSpec(f"p{n}", n, ("name",)) for n in range(200))
    (reason,) = why_not_built(replace(left(), frames=(TxFrameSpec("f", "eap0", "10.0.0.1", many),)))
    assert reason.startswith("it cannot be built: ")
