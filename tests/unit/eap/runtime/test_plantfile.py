"""Plants with the buses that they name."""

from __future__ import annotations

import pytest

from eap.errors import ConfigError
from eap.ids import InterfaceUri, NetId
from eap.pd.spec import BusPortSpec, PortKind, PortSpec, StationSpec
from eap.runtime.plantfile import load_plant
from eap.runtime.socket_plan import require_own_buses

PLANT = """\
plant: small
stations:
  - name: a
    net_id: 127.0.9.1.1.1
    ports:
      - {name: bus0, kind: bus, interface: sim://buses/io.yaml, net_id: 127.0.9.1.2.1}
    links:
      - {from: bus0.inputs.start, to: bus0.outputs.lamp}
"""
BUS = """\
bus: io
slaves:
  - {name: inputs, kind: digital, inputs: [{name: start}]}
  - {name: outputs, kind: digital, outputs: [{name: lamp}]}
"""


def write(tmp_path, plant=PLANT, bus=BUS):
    (tmp_path / "buses").mkdir()
    (tmp_path / "buses" / "io.yaml").write_text(bus)
    path = tmp_path / "plant.yaml"
    path.write_text(plant)
    return path


def test_a_plant_comes_with_its_buses(tmp_path):
    [station] = load_plant(write(tmp_path)).plant.stations
    [port] = station.ports
    assert [(slave.name, slave.station) for slave in port.bus.slaves] == [
        ("inputs", 1001),
        ("outputs", 1002),
    ]
    assert port.bus.file == str(tmp_path / "buses" / "io.yaml")
    assert [(link.source, link.target) for link in station.links] == [
        ("bus0.inputs.start", "bus0.outputs.lamp")
    ]


def test_load_plant_includes_findings_of_bus_file(tmp_path):
    path = write(tmp_path, bus=BUS.replace("kind: digital, inputs", "kind: digial, inputs"))
    result = load_plant(path)
    assert result.plant is None
    [finding] = result.findings
    assert (finding.file, finding.line) == (str(tmp_path / "buses" / "io.yaml"), 3)
    assert finding.message == "kind is 'digial'"


def test_plant_in_place_of_a_bus_is_one_finding(tmp_path):
    (tmp_path / "plant.yaml").write_text(PLANT.replace("buses/io.yaml", "plant.yaml"))
    (finding,) = load_plant(tmp_path / "plant.yaml").findings
    assert (finding.message, finding.expected) == (
        "it is a plant file",
        "a bus file; 'eapctl run' runs a plant file",
    )


def test_a_slave_whose_name_no_plant_can_use(tmp_path):
    path = write(tmp_path, bus=BUS.replace("name: inputs", "name: my inputs"))
    [finding] = load_plant(path).findings
    assert str(finding).startswith(f"{path}:6: port bus0 has a slave 'my inputs'; expected a text")


def station(name, interface, kind=PortKind.BUS):
    bus = BusPortSpec() if kind is PortKind.BUS else None
    return StationSpec(
        name,
        NetId.parse("1.1.1.1.1.1"),
        1000,
        (PortSpec("p", kind, InterfaceUri.parse(interface), NetId.parse("1.1.1.1.2.1"), bus=bus),),
    )


@pytest.mark.parametrize(
    ("first", "second"),
    [(PortKind.BUS, PortKind.BUS), (PortKind.BUS, PortKind.EAP), (PortKind.EAP, PortKind.BUS)],
)
def test_stations_do_not_share_the_interface_of_a_bus(first, second):
    stations = [station("a", "ethernet://eth1", first), station("b", "ethernet://eth1", second)]
    with pytest.raises(ConfigError, match=r"ethernet://eth1 is the interface of a/p and of b/p"):
        require_own_buses(stations)
    require_own_buses(stations[:1])


def test_everything_else_may_be_shared():
    eap = PortKind.EAP
    require_own_buses([station("a", "ethernet://eth1", eap), station("b", "ethernet://eth1", eap)])
    require_own_buses([station("a", "sim:///x.yaml"), station("b", "sim:///x.yaml")])
    require_own_buses([station("a", "ethernet://eth1"), station("b", "ethernet://eth2")])
