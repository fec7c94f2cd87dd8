from __future__ import annotations

import re
import shutil
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ams.spec import (
    AccessRule,
    AmsUser,
    DirectoryPort,
    DirectoryStation,
    HopSpec,
    RouteSpec,
    TransportKind,
)
from eap.codec import datatypes
from eap.codec.ams import AMS_TCP_PORT
from eap.codec.amsdiscovery import AMS_UDP_PORT
from eap.codec.ethercat import EAP_PORT
from eap.config.load import INTERFACE_PATH, NET_ID_PATHS, blank
from eap.ids import InterfaceUri, NetId, decode_value, encode_value
from eap.pd.layout import plan_layout
from eap.pd.spec import (
    LinkSpec,
    OnChangeSpec,
    PortKind,
    PortSpec,
    StationSpec,
    Substitute,
    TriggerSpec,
    Wake,
    Writer,
)
from eap.runtime.plantfile import load_plant as load_shipped

PLANTS = Path(__file__).parents[4] / "config"


@pytest.fixture(params=sorted(PLANTS.glob("*.yaml")), ids=lambda path: path.name)
def shipped(request):
    result = load_shipped(request.param)
    assert [str(finding) for finding in result.findings] == []
    return result.plant


def test_shipped_plants_have_no_findings_and_a_process_image(shipped):
    for station in shipped.stations:
        assert plan_layout(station).size > 0


def test_a_station_travels_as_json(shipped):
    for station in shipped.stations:
        text = msgspec.json.encode(station, enc_hook=encode_value)
        assert msgspec.json.decode(text, type=StationSpec, dec_hook=decode_value) == station


def test_the_demo_is_the_ring_that_the_contract_describes():
    plant = load_shipped(PLANTS / "demo.yaml").plant
    assert [s.name for s in plant.stations] == ["island-01", "island-02", "island-03"]
    assert [str(s.ports[0].interface) for s in plant.stations] == [
        f"udp://127.0.1.{n}" for n in (1, 2, 3)
    ]
    assert "setpoint" in {v.name for v in plant.stations[0].variables if v.writer == "application"}
    assert plant.stations[0].ports[0].join == ("239.88.164.1",)
    for station in plant.stations:
        eap0, bus0 = station.ports
        assert (eap0.name, eap0.kind, bus0.name, bus0.kind) == ("eap0", "eap", "bus0", "bus")
        assert str(bus0.interface).startswith("sim:///")
    drive = plant.stations[0].ports[1].bus.slaves[0]
    assert (drive.name, drive.station) == ("drive", 1001)


def test_the_solar_line_has_the_sizes_of_the_contract():
    plant = load_shipped(PLANTS / "solar-line.yaml").plant
    sizes = {600: 0, 1024: 0}
    received = 0
    for station in plant.stations:
        assert station.cycle_us == 10_000
        types = {v.name: datatypes.parse(v.type) for v in station.variables}
        for pd in (pd for frame in station.frames for pd in frame.pds):
            sizes[datatypes.layout(types[name] for name in pd.variables).size] += 1
        received += len(station.subscriptions)
        assert all(rx.step == 1 for rx in station.subscriptions)
    assert sizes == {600: 26, 1024: 28}
    assert received == 54
    assert [s.name for s in plant.stations] == [f"island-{n:02}" for n in range(1, 15)] + [
        "control"
    ]
    hosts = [s.ports[0].interface.host.removeprefix("127.0.1.") for s in plant.stations]
    assert hosts == [*map(str, range(1, 15)), "100"]


def test_findings_carry_everything_that_the_contract_names(load_plant):
    [finding] = load_plant(("id: 1,", "id: 70000,")).findings
    assert msgspec.to_builtins(finding) == {
        "file": finding.file,
        "line": 15,
        "path": "stations[0].publish[0].id",
        "message": "id is 70000",
        "expected": "a whole number from 0 to 65535",
    }
    assert Path(finding.file).name == "plant.yaml"


def test_all_findings_come_at_once_in_the_order_of_the_file(load_plant):
    result = load_plant(
        ("count: UDINT", "count: UDIMT"),
        ("to: 127.0.9.2", "to: nowhere"),
        ("net_id: 127.0.9.2.2.1", "net_id: 127.0.9.1.2.1"),
        ("timeout_ms: 50", "timeout_ms: 5"),
    )
    assert result.plant is None
    assert [finding.line for finding in result.findings] == [9, 13, 19, 21]


@pytest.mark.parametrize(
    ("access", "required"),
    [("", False), ("access: {audit: optional}\n", False), ("access: {audit: required}\n", True)],
)
def test_plant_says_whether_the_audit_is_required(load_plant, access, required):
    plant = load_plant(("stations:\n", f"{access}stations:\n")).plant
    assert plant.audit_required is required


WORDS = (PLANTS / "demo.yaml").read_text().split(" ")
ODD = [
    "-1",
    "{}",
    "[]",
    "null",
    "x:",
    "[a]",
    "1e99",
    "udp://x",
    "0.0.0.0",
    "true,",
    "/",
    "&a",
    "*a",
]


@given(
    st.lists(st.tuples(st.integers(0, len(WORDS) - 1), st.sampled_from(ODD + WORDS)), max_size=4)
)
def test_no_content_is_a_traceback(tmp_path_factory, changes):
    words = WORDS.copy()
    for position, word in changes:
        words[position] = word
    folder = tmp_path_factory.getbasetemp()
    if not (folder / "buses").exists():
        shutil.copytree(PLANTS / "buses", folder / "buses")
    path = folder / "odd.yaml"
    path.write_text(" ".join(words))
    result = load_shipped(path)
    assert (result.plant is None) == bool(result.findings)


@pytest.mark.parametrize(
    ("old", "new", "count"),
    [
        ("timeout_ms: 50, substitute", "timeout_sm: 50, substitute", 1),
        ("timeout_ms: 50, substitute", "timeout_ms: 3, substitute", 1),
        ("pieces: {kind: counter}", "pieces: {kind: conuter}", 1),
        ("pieces: {kind: counter}", "peices: {kind: counter}", 1),
    ],
)
def test_fault_in_an_anchor_is_one_finding(tmp_path: Path, old: str, new: str, count: int) -> None:
    text = (PLANTS / "solar-line.yaml").read_text()
    assert text.count(old) == 1
    path = tmp_path / "line.yaml"
    path.write_text(text.replace(old, new))
    findings = load_shipped(path).findings
    assert len(findings) == count, [str(each) for each in findings]
    assert "more places, by an anchor)" in findings[0].message


SECURITY = PLANTS.parent / "docs" / "security.md"


def test_plant_of_the_security_page_has_no_findings(tmp_path):
    (text,) = re.findall(
        r"^```yaml\n(plant: tunnel.*?)^```$", SECURITY.read_text(), re.MULTILINE | re.DOTALL
    )
    path = tmp_path / "plant.yaml"
    path.write_text(text)
    result = load_shipped(path)
    assert result.findings == result.warnings == ()


def test_security_page_lists_the_ports():
    lines = SECURITY.read_text().splitlines()
    listed = " ".join(line for line in lines if line.startswith("|"))
    for number in (EAP_PORT, EAP_PORT + 1, AMS_TCP_PORT, AMS_UDP_PORT):
        assert str(number) in listed


def test_one_port_and_nothing_else():
    result = blank("mixer", "udp://10.0.0.4", "10.0.0.4.2.1", 5000)
    port = PortSpec(
        "eap0", PortKind.EAP, InterfaceUri.parse("udp://10.0.0.4"), NetId.parse("10.0.0.4.2.1")
    )
    assert result.findings == ()
    assert result.plant is not None
    assert result.plant.name == "mixer"
    assert result.plant.stations == (
        StationSpec("mixer", NetId.parse("10.0.0.4.1.1"), 5000, (port,)),
    )


def test_the_router_has_a_net_id_of_its_own():
    result = blank("mixer", "udp://10.0.0.4", "1.2.3.4.0.9", 5000)
    assert result.plant is not None
    assert result.plant.stations[0].net_id == NetId.parse("1.2.3.4.255.9")


@pytest.mark.parametrize(
    ("name", "interface", "net_id", "paths"),
    [
        ("mi/xer", "udp://10.0.0.4", "10.0.0.4.2.1", ["station"]),
        ("mixer", "upd://10.0.0.4", "10.0.0.4.2.1", [INTERFACE_PATH]),
        ("mixer", "sim://bus.yaml", "10.0.0.4.2.1", [INTERFACE_PATH]),
        ("mixer", "udp://239.1.1.1", "10.0.0.4.2.1", [INTERFACE_PATH]),
        ("mixer", "udp://10.0.0.4", "10.0.0.4", [NET_ID_PATHS[1]]),
        ("mixer", "udp://10.0.0.4", "0.0.0.0.0.0", [NET_ID_PATHS[0]]),
        ("mixer", "udp://10.0.0.4", "0.0.0.0.1.0", [NET_ID_PATHS[1]]),
    ],
)
def test_the_rules_of_plant_files_hold(name, interface, net_id, paths):
    result = blank(name, interface, net_id, 5000)
    assert result.plant is None
    assert [finding.path for finding in result.findings] == paths


PD = "id: 1, version: 3,"
FROM = "from: left/state"
VARIABLES = ", variables: {a: REAL, b: UDINT}}"
LEFT_PORT = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
COUNTER = "count: {kind: counter}"
RIGHT_PORT = "net_id: 127.0.9.2.2.1"


def bus_port(more="", interface="sim://line.yaml"):
    bus = f"{{name: bus0, kind: bus, interface: {interface}, net_id: 127.0.9.1.3.1{more}}}"
    return LEFT_PORT, f"{LEFT_PORT}\n      - {bus}"


@pytest.fixture
def stations(load_plant):
    def of(*edits):
        result = load_plant(*edits)
        assert result.findings == ()
        return result.plant.stations

    return of


def test_every_variable_has_its_writer(stations, tmp_path):
    (tmp_path / "oven.csv").write_text("heat\n1\n")
    left, right = stations(
        ("count: UDINT", "count: UDINT\n      load: REAL\n      heat: real32"),
        (
            "count: {kind: counter}",
            (
                "count: {kind: counter}\n      load: {kind: host, measure: load1}\n"
                "      heat: {kind: csv, file: oven.csv, column: heat}"
            ),
        ),
    )
    assert {v.name: v.writer for v in left.variables} == {
        "speed": Writer.APPLICATION,
        "count": Writer.ENGINE,
        "load": Writer.SERVICES,
        "heat": Writer.SERVICES,
    }
    assert {v.name: v.writer for v in right.variables} == {"a": Writer.ENGINE, "b": Writer.ENGINE}
    assert left.variables[3].type == "REAL"
    assert left.sources[2].file == str(tmp_path / "oven.csv")


def test_variables_taken_over_keep_type_unit_and_order(stations):
    _, right = stations((VARIABLES, "}"))
    assert [(v.name, v.type, v.unit, v.default) for v in right.variables] == [
        ("seen.speed", "REAL", "1/min", None),
        ("seen.count", "UDINT", "", None),
    ]
    assert right.subscriptions[0].variables == ("seen.speed", "seen.count")


def test_a_subscription_knows_its_publisher(stations):
    _, right = stations((PD, f"{PD} cycle_us: 20000,"), ("timeout_ms: 50", "timeout_ms: 60"))
    [rx] = right.subscriptions
    assert (rx.publisher, rx.pd_id, rx.version) == ("127.0.9.1.2.1", 1, 3)
    assert (rx.sender_cycle_us, rx.step, rx.timeout_ms) == (10000, 2, 60)
    assert rx.substitute is Substitute.HOLD


@pytest.mark.parametrize(
    ("source", "facts"),
    [
        ("from: {publisher: any, id: 1}", ("", 1, 3, 1, 10000)),
        ("from: {publisher: any, id: 7}, foreign: true", ("", 7, 0, 0, 0)),
        (
            (
                "foreign: true, version: 4, "
                "from: {publisher: 9.9.9.9.9.9, id: 7, cycle_us: 500, step: 2}"
            ),
            ("9.9.9.9.9.9", 7, 4, 2, 500),
        ),
    ],
)
def test_foreign_publisher_has_given_cycle_and_step(stations, source, facts):
    [rx] = stations((FROM, source))[1].subscriptions
    assert (rx.publisher, rx.pd_id, rx.version, rx.step, rx.sender_cycle_us) == facts


@pytest.mark.parametrize(
    ("edit", "source"),
    [
        (FROM, "127.0.9.1"),
        (f"{FROM}, source: any", ""),
        (f"{FROM}, source: 10.0.0.7", "10.0.0.7"),
        ("from: {publisher: any, id: 1}", "127.0.9.1"),
        ("from: {publisher: 9.9.9.9.9.9, id: 7}, foreign: true", ""),
        ("from: {publisher: 9.9.9.9.9.9, id: 7}, foreign: true, source: 10.0.0.7", "10.0.0.7"),
    ],
)
def test_subscription_expects_the_address_of_its_publisher_by_default(stations, edit, source):
    assert stations((FROM, edit))[1].subscriptions[0].source == source


def test_of_several_publishers_only_the_common_pace_is_known(stations):
    more = "\n      - {name: more, frame: more, id: 1, divider: 2, variables: [speed, count]}"
    second_port = "{name: eap1, kind: eap, interface: tcp://127.0.9.3, net_id: 127.0.9.1.3.1}"
    _, right = stations(
        ("variables: [speed, count]}", "variables: [speed, count]}" + more),
        ("to: 127.0.9.2}", "to: 127.0.9.2}\n      - {name: more, port: eap1, to: tcp://127.0.9.2}"),
        ("net_id: 127.0.9.1.2.1}", f"net_id: 127.0.9.1.2.1}}\n      - {second_port}"),
        (FROM, "from: {publisher: any, id: 1}"),
    )
    assert (right.subscriptions[0].step, right.subscriptions[0].sender_cycle_us) == (0, 10000)


def test_triggers_arrive_as_written(stations):
    def trigger(text):
        left, _ = stations((PD, f"{PD} {text}"), ("timeout_ms: 50, ", ""))
        return left.frames[0].pds[0].trigger

    assert trigger("") == TriggerSpec()
    assert trigger("divider: 4, modulo: 3,") == TriggerSpec(divider=4, modulo=3)
    assert trigger("on_change: {timeout_ms: 9},") == TriggerSpec(on_change=OnChangeSpec(9, 0))
    assert trigger("cycle_us: 20000, event: true,") == TriggerSpec(cycle_us=20000, event=True)


def test_a_port_joins_what_its_subscriptions_need(stations):
    _, right = stations(
        ("to: 127.0.9.2", "to: 239.1.1.1"),
        (RIGHT_PORT, f"{RIGHT_PORT}, join: [239.1.1.2, 239.1.1.1], wake: arrival"),
    )
    assert right.ports[0].join == ("239.1.1.2", "239.1.1.1")
    assert right.ports[0].wake is Wake.ARRIVAL
    assert not right.ports[0].broadcast
    left, right = stations(("to: 127.0.9.2", "to: broadcast"))
    assert right.ports[0].broadcast
    assert not left.ports[0].broadcast
    assert left.frames[0].destination == "255.255.255.255"


def test_ethernet_ports_join_groups_and_keep_their_tag(stations):
    tagged = "ethernet://b, vlan: {id: 7, priority: 5}, join: [01-01-05-04-00-08]"
    _, right = stations(
        ('"udp://127.0.9.1"', "ethernet://a, vlan: {id: 7}"),
        ('"udp://127.0.9.2"', tagged),
        ("to: 127.0.9.2", "to: 01:01:05:04:00:07"),
    )
    assert right.ports[0].join == ("01:01:05:04:00:08", "01:01:05:04:00:07")
    assert (right.ports[0].vlan_id, right.ports[0].vlan_priority) == (7, 5)


def test_a_bus_port_is_complete(stations, tmp_path):
    left, _ = stations(bus_port())
    port = left.ports[1]
    file = str((tmp_path / "line.yaml").resolve())
    assert (port.kind, str(port.interface), str(port.net_id)) == (
        "bus",
        f"sim://{file}",
        "127.0.9.1.3.1",
    )
    assert (port.bus.file, port.bus.target, port.bus.clocks) == (file, "OP", False)
    [slave] = port.bus.slaves
    assert (slave.name, slave.station, slave.vendor, slave.product) == ("valves", 1001, 1, 2)
    assert [entry.variable for entry in slave.outputs] == [
        "bus0.valves.valve",
        "bus0.valves.lamp",
        "",
        "bus0.valves.speed",
    ]
    assert [entry.bit_length for entry in slave.inputs] == [1, 7, 16]


def test_a_real_bus_has_its_interface_and_may_be_described(stations, tmp_path):
    uri = "ethernet://eth1"
    keys = (
        ", bus: line.yaml, target: SAFEOP, clocks: true, frame_timeout_us: 5000, frame_retries: 1"
    )
    left, _ = stations(bus_port(keys, uri))
    assert str(left.ports[1].interface) == uri
    assert left.ports[1].bus.file == str((tmp_path / "line.yaml").resolve())
    assert (left.ports[1].bus.target, left.ports[1].bus.clocks) == ("SAFEOP", True)
    assert (left.ports[1].bus.frame_timeout_us, left.ports[1].bus.frame_retries) == (5000, 1)
    left, _ = stations(bus_port("", uri))
    assert (left.ports[1].bus.file, left.ports[1].bus.slaves) == ("", ())
    assert [v.name for v in left.variables][2:] == ["bus0.state", "bus0.wkc_ok"]


def test_an_output_belongs_to_its_link_or_to_the_application(stations):
    links = (
        "\n    links:\n      - {from: bus0.valves.limit, to: bus0.valves.valve}\n"
        "      - {from: bus0.valves.speed, to: speed, scale: 0.5}"
    )
    left, _ = stations(bus_port(), (COUNTER, COUNTER + links))
    assert {v.name: v.writer for v in left.variables if "count" not in v.name} == {
        "speed": Writer.ENGINE,
        "bus0.state": Writer.ENGINE,
        "bus0.wkc_ok": Writer.ENGINE,
        "bus0.valves.state": Writer.ENGINE,
        "bus0.valves.valve": Writer.ENGINE,
        "bus0.valves.lamp": Writer.APPLICATION,
        "bus0.valves.speed": Writer.APPLICATION,
        "bus0.valves.limit": Writer.ENGINE,
        "bus0.valves.status_word": Writer.ENGINE,
    }


def test_links_are_complete_and_in_the_order_in_which_they_run(stations):
    links = (
        "\n    links:\n      - {from: a, to: bus0.valves.valve}\n"
        "      - {from: bus0.valves.status_word, from_bit: 3, to: a}\n"
        "      - {from: bus0.valves.speed, to: speed, scale: 0.5, offset: -1, swap: true}"
    )
    more = ("count: UDINT", "count: UDINT\n      a: BOOL")
    left, _ = stations(bus_port(), more, (COUNTER, COUNTER + links))
    assert left.links == (
        LinkSpec("bus0.valves.status_word", "a", source_bit=3, bits=1),
        LinkSpec("a", "bus0.valves.valve"),
        LinkSpec("bus0.valves.speed", "speed", scale=0.5, offset=-1.0, swap=True),
    )


def test_subscribers_copy_bus_variables(stations):
    _, right = stations(
        bus_port(), (VARIABLES, "}"), ("[speed, count]", "[bus0.valves.limit, bus0.valves.speed]")
    )
    assert [(v.name, v.type, v.writer) for v in right.variables] == [
        ("seen.bus0.valves.limit", "BOOL", Writer.ENGINE),
        ("seen.bus0.valves.speed", "INT", Writer.ENGINE),
    ]


LEFT_EAP_PORT = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
BUS = "{name: bus0, kind: bus, interface: sim://line.yaml, net_id: 127.0.9.1.3.1}"


@pytest.fixture
def plant(load_plant):
    def of(*edits):
        result = load_plant(*edits)
        assert result.findings == ()
        return result.plant

    return of


def test_stations_that_share_an_interface_have_routes_to_each_other(plant):
    assert plant().routing["left"].routes == (
        RouteSpec(
            name="right",
            net_id="127.0.9.2.1.1",
            hop=HopSpec(TransportKind.UDP, "eap0", "127.0.9.2:34980"),
            router="127.0.9.2.1.1",
            is_derived=True,
        ),
    )
    assert plant().routing["right"].routes[0].name == "left"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("net_id: 127.0.9.2.1.1", "net_id: 5.5.5.5.1.1"),  # the router's is not like the port's
        ("net_id: 127.0.9.1.2.1", "net_id: 127.0.9.2.9.9"),  # the other station's begin like them
    ],
)
def test_net_ids_without_four_octets_to_themselves_have_a_route_each(plant, old, new):
    routes = plant((old, new)).routing["left"].routes
    assert [route.octets for route in routes] == [6, 6]
    assert routes[1].net_id == "127.0.9.2.2.1"
    assert routes[0].router == routes[1].router == routes[0].net_id


def test_the_directory_names_all_ports_and_slaves(plant):
    left = plant((LEFT_EAP_PORT, f"{LEFT_EAP_PORT}\n      - {BUS}")).directory[0]
    assert left == DirectoryStation(
        "left",
        NetId.parse("127.0.9.1.1.1"),
        (
            DirectoryPort(
                "eap0", False, NetId.parse("127.0.9.1.2.1"), InterfaceUri.parse("udp://127.0.9.1")
            ),
            DirectoryPort(
                "bus0",
                True,
                NetId.parse("127.0.9.1.3.1"),
                InterfaceUri.parse("sim://line.yaml"),
                {"valves": 1001},
            ),
        ),
    )


def routes(*items):
    return LEFT_EAP_PORT, f"{LEFT_EAP_PORT}\n    routes: [{', '.join(items)}]"


def test_a_route_that_is_written_stands_for_the_derived_ones(plant):
    item = "{to: right, virtual: 9.9.9.9.1.1, unidirectional: true, timeout_ms: 50, probe: false}"
    assert plant(routes(item)).routing["left"].routes == (
        RouteSpec(
            name="right",
            net_id="127.0.9.2.1.1",
            hop=HopSpec(TransportKind.UDP, "eap0", "127.0.9.2:34980"),
            router="127.0.9.2.1.1",
            virtual="9.9.9.9.1.1",
            is_unidirectional=True,
            timeout_ms=50,
            is_probed=False,
        ),
    )


def test_what_is_written_comes_first(plant):
    found = plant(routes("{to: default, via: 127.0.9.77}")).routing["left"].routes
    assert [(route.name, route.octets, route.is_derived) for route in found] == [
        ("default", 0, False),
        ("right", 4, True),
    ]
    assert (found[0].net_id, found[0].router) == ("0.0.0.0.0.0", "")


def test_stations_that_share_but_a_network_reach_each_other_by_its_broker(plant):
    broker = "    routes: [{mqtt: mqtt://b, network: n}]"
    right = '"udp://127.0.9.2", net_id: 127.0.9.2.2.1}'
    told = plant(
        ("to: 127.0.9.2}", "to: 239.1.1.1}"),
        (LEFT_EAP_PORT, LEFT_EAP_PORT.replace("udp://127.0.9.1", "udp://10.0.0.1") + f"\n{broker}"),
        (right, f"{right}\n{broker}"),
    ).routing["left"]
    assert [route.hop for route in told.routes] == [
        HopSpec(TransportKind.MQTT, "n", "127.0.9.2.1.1")
    ]
    assert not told.routes[0].is_probed
    assert [each.host for each in told.mqtt] == ["b"]


def test_rules_users_and_learning_are_part_of_routing(plant, tmp_path):
    more = """
    access: [{name: a, allow: [all]}]
    learn: false
    users: [{name: me, password_file: line.yaml}]"""
    told = plant((LEFT_EAP_PORT, LEFT_EAP_PORT + more)).routing["left"]
    assert told.access == (AccessRule("a"),)
    assert told.users == (AmsUser("me", str(tmp_path / "line.yaml")),)
    assert not told.learn
