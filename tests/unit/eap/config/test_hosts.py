from __future__ import annotations

import re
from ipaddress import IPv4Address
from pathlib import Path

import pytest
from msgspec.structs import replace

from eap.ams.spec import AccessService
from eap.config.hosts import find_host, has_address, is_served_on
from eap.config.load import load
from eap.config.plant_sections import HostSection
from eap.config.web_sections import MetricsSection, WebSection
from eap.errors import ConfigError
from eap.ids import InterfaceUri

DOCS = Path(__file__).parents[4] / "docs"
PLANT = """\
plant: line
hosts:
  - {name: cell-a, address: 10.0.0.1, stations: [oven], interfaces: {lan: enp3s0}}
  - {name: cell-b, address: b.example.org, addresses: [10.0.0.2], user: eap, stations: [panel]}
stations:
  - name: oven
    net_id: 10.0.0.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://10.0.0.1", net_id: 10.0.0.1.2.1}
      - {name: eap1, kind: eap, interface: "ethernet://lan", net_id: 10.0.0.1.3.1}
    variables: {count: UDINT}
    sources: {count: {kind: counter}}
    frames: [{name: out, port: eap0, to: panel/eap0}]
    publish: [{name: state, frame: out, id: 1, variables: [count]}]
  - name: panel
    net_id: 10.0.0.2.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://10.0.0.2", net_id: 10.0.0.2.2.1}
      - {name: eap1, kind: eap, interface: "ethernet://lan", net_id: 10.0.0.2.3.1}
    subscribe: [{name: oven, port: eap0, from: oven/state, timeout_ms: 100}]
"""
LOOPBACK = [("10.0.0.", "127.0.0.")]
LOOP = [('"ethernet://lan"', '"loop://lan"'), (", interfaces: {lan: enp3s0}", "")]
OWN_ADDRESS = "udp://10.0.0.1"


@pytest.fixture
def loaded(tmp_path):
    def load_with(*edits):
        text = PLANT
        for old, new in edits:
            assert old in text, old
            text = text.replace(old, new)
        path = tmp_path / "plant.yaml"
        path.write_text(text)
        return load(path, lambda _: ())

    return load_with


def test_ports_have_the_interface_names_of_their_host(loaded):
    plant = loaded().plant
    interfaces = {spec.name: spec.ports[1].interface for spec in plant.stations}
    assert interfaces == {
        "oven": InterfaceUri.parse("ethernet://enp3s0"),
        "panel": InterfaceUri.parse("ethernet://lan"),
    }
    # Two interfaces of one name in the file are one network, whatever the hosts call them.
    assert {route.name for route in plant.routing["oven"].routes} == {"panel"}
    assert {each.ports[1].interface.host for each in plant.directory} == {"enp3s0", "lan"}


def test_part_of_a_host_has_its_stations_and_servers(loaded):
    plant = replace(
        loaded().plant, web=WebSection(listen="10.0.0.2:8080"), metrics=MetricsSection()
    )
    parts = [plant.on_host(host) for host in plant.hosts]
    assert [[each.name for each in part.stations] for part in parts] == [["oven"], ["panel"]]
    assert [part.web is not None for part in parts] == [False, True]
    assert all(part.metrics for part in parts)
    assert all(len(part.directory) == 2 for part in parts)


@pytest.mark.parametrize(
    ("edits", "finding"),
    [
        ([("stations: [panel]", "stations: []")], "4: host cell-b runs no station; at least one"),
        (
            [("stations: [panel]", "stations: [oven]")],
            "4: station oven runs on cell-a already; one",
        ),
        ([("stations: [panel]", "stations: [oven]")], "15: station panel is on no host; it in sta"),
        ([("[panel]", "[pannel]")], "4: no station 'pannel' in this plant, did you mean panel?; "),
        ([("name: cell-b", "name: cell-a")], "4: host 'cell-a' exists already (line 3); a name of"),
        ([("b.example.org", "10.0.0.256")], "4: '10.0.0.256' is no address of host cell-b; an IPv"),
        ([("b.example.org", "10.1.0.0/24")], "4: '10.1.0.0/24' is a network; an IPv4 address or a"),
        (
            [("b.example.org", "10.0.0.1")],
            "4: 10.0.0.1 of host cell-b is an address of host cell-a",
        ),
        ([("[10.0.0.2]", "[here]")], "4: 'here' is no address of host cell-b; an IPv4 address, or"),
        ([("[10.0.0.2]", "[10.0.0.0/28]")], "4: 10.0.0.0/28 of host cell-b is an address of host "),
        (
            [("[10.0.0.2]", "[10.0.0.3]")],
            (
                "18: 10.0.0.2 of panel/eap0 is no address of its host cell-b; one of"
                " b.example.org, 10.0.0.3, or the address in addresses: of host cell-b"
            ),
        ),
        (
            [
                ("[oven]", "[panel]"),
                (
                    "addresses: [10.0.0.2], user: eap, stations: [panel]",
                    "addresses: [10.0.0.2], stations: [oven]",
                ),
            ],
            "9: 10.0.0.1 of oven/eap0 is no address of its host cell-b, but of host cell-a",
        ),
        (
            [("lan: enp3s0", "wan: enp3s0")],
            "3: no port of a station on cell-a is at ethernet://wan",
        ),
        ([("enp3s0", "enp3s0-and-more0")], "3: 'enp3s0-and-more0' is no interface name; a name of"),
        (
            [
                (
                    "10.0.0.1.3.1}",
                    (
                        "10.0.0.1.3.1}\n      - {name: bus0, kind: bus, net_id: 10.0.0.1.4.1,"
                        ' interface: "ethernet://enp3s0"}'
                    ),
                )
            ],
            "3: interface enp3s0 of host cell-a has two names here: enp3s0, lan; one name for each",
        ),
        (
            LOOP,
            "19: loop://lan joins oven/eap1 on host cell-a and panel/eap1 on host cell-b: it ex",
        ),
        (
            LOOPBACK,
            "13: frame 'out' goes to 127.0.0.2, which does not leave this host: panel runs ",
        ),
        (
            LOOPBACK,
            (
                "20: subscription 'oven' of host cell-b receives from host cell-a, but oven/eap0"
                " is at udp://127.0.0.1; addresses that other hosts reach"
            ),
        ),
        (
            [("stations:\n", "web: 10.9.9.9:8080\nstations:\n")],
            "5: web listens at 10.9.9.9, which no",
        ),
        (
            [("stations:\n", "s7: {server: {listen: 10.9.9.9:102, blocks: {1: []}}}\nstations:\n")],
            "5: s7 listens at 10.9.9.9, which no host has; an address of a host, or 127.0.0.1",
        ),
        (
            [("stations:\n", "modbus: {server: {listen: 10.9.9.9:502}}\nstations:\n")],
            "5: modbus listens at 10.9.9.9, which no host has",
        ),
        (
            [("stations:\n", "mqtt: {broker: mqtt://b, client_id: x}\nstations:\n")],
            "5: client_id 'x' would be that of each host; none: each host then has one of its own",
        ),
        (
            [("10.0.0.2.1.1", "10.0.0.1.1.1")],
            "16: NetID 10.0.0.1.1.1 is used twice (first in line 7); a NetID of its own",
        ),
    ],
)
def test_check_judges_the_plant_with_all_hosts(loaded, edits, finding):
    found = [f"{each.line}: {each.message}; {each.expected}" for each in loaded(*edits).findings]
    assert any(each.startswith(finding) for each in found), found


def test_hosts_without_an_item_are_a_finding(loaded):
    text = PLANT[PLANT.index("hosts:") : PLANT.index("stations:\n")]
    (found,) = loaded((text, "hosts: []\n")).findings
    assert found.message == "the plant has no hosts"


def test_route_between_hosts_never_leads_to_a_loopback_address(loaded):
    edits = [
        ("[10.0.0.2]", "[10.0.0.2, 10.0.0.9]"),
        ('interface: "udp://10.0.0.2"', 'interface: "udp://127.0.0.2"'),
        ("    frames: [{name: out, port: eap0, to: panel/eap0}]\n", ""),
        ("    publish: [{name: state, frame: out, id: 1, variables: [count]}]\n", ""),
        ("    subscribe: [{name: oven, port: eap0, from: oven/state, timeout_ms: 100}]\n", ""),
        ('interface: "udp://10.0.0.1"', 'interface: "udp://127.0.0.1"'),
    ]
    plant = loaded(*edits).plant
    (route,) = plant.routing["oven"].routes
    assert route.hop.kind == "ethernet"


HOSTS = (
    HostSection(name="a", address="10.0.0.1", stations=("x",)),
    HostSection(
        name="b", address="b.example.org", addresses=("10.0.0.2", "10.2.0.0/16"), stations=("y",)
    ),
)


@pytest.mark.parametrize(
    ("names", "addresses", "found"),
    [
        (["vm"], ["127.0.0.1", "10.0.0.1"], "a"),
        (["a"], ["127.0.0.1"], "a"),
        (["b.example.org", "b"], [], "b"),
        (["vm"], ["10.0.0.2"], "b"),
    ],
)
def test_own_host_is_found_by_name_or_address(names, addresses, found):
    assert find_host("line", HOSTS, "", names, addresses).name == found


def test_own_host_is_the_wanted_one_whatever_the_computer_is():
    assert find_host("line", HOSTS, "b", ["a"], ["10.0.0.1"]).name == "b"


@pytest.mark.parametrize(
    ("wanted", "names", "addresses", "reason"),
    [
        (
            "",
            ["vm"],
            ["127.0.0.1", "10.2.0.7"],
            (
                "plant line: this computer (vm, 10.2.0.7) is none of its hosts, a at 10.0.0.1, b at"
                " b.example.org; choose one with --host NAME"
            ),
        ),
        (
            "",
            ["a"],
            ["10.0.0.2"],
            (
                "plant line: this computer is several of its hosts: a (by name a), b (by address"
                " 10.0.0.2); choose one with --host NAME"
            ),
        ),
        ("c", [], [], "plant line has no host 'c': it has a, b"),
    ],
)
def test_host_that_is_not_certain_is_an_error_with_the_known_ones(wanted, names, addresses, reason):
    with pytest.raises(ConfigError) as error:
        find_host("line", HOSTS, wanted, names, addresses)
    assert str(error.value) == reason


def test_addresses_of_a_host_may_be_networks():
    assert has_address(HOSTS[1], IPv4Address("10.2.3.4"))
    assert not has_address(HOSTS[0], IPv4Address("10.2.3.4"))
    assert is_served_on(HOSTS[1], "10.2.3.4:8080")
    assert not is_served_on(HOSTS[0], "10.2.3.4:8080")
    assert is_served_on(HOSTS[0], "0.0.0.0:8080")
    assert is_served_on(HOSTS[0], "[::1]:8080")


def test_plant_of_the_page_is_right(tmp_path):
    page = (DOCS / "several-hosts.md").read_text()
    (text,) = [each for each in yaml_blocks(page) if each.startswith("plant:")]
    path = tmp_path / "line.yaml"
    path.write_text(text)
    result = load(path, lambda _: ())
    assert (result.findings, result.warnings) == ((), ())
    (rule,) = [each for each in yaml_blocks(page) if each.startswith("    access:")]
    panel = "  - name: panel\n"
    path.write_text(text.replace(panel, panel + rule))
    plant = load(path, lambda _: ()).plant
    assert [each.services for each in plant.routing["panel"].access] == [(AccessService.CONFIGURE,)]
    # Routes between the hosts follow from the addresses of the ports.
    assert [each.hop.address for each in plant.routing["oven"].routes] == ["10.77.0.2:34980"]


def test_hosts_of_the_reference_are_right(tmp_path):
    page = (DOCS / "plant-file.md").read_text()
    (text,) = [each for each in yaml_blocks(page) if each.startswith("hosts:")]
    stations = "".join(
        f"""
  - name: {name}
    net_id: 10.0.0.{number}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://10.0.0.{number}", net_id: 10.0.0.{number}.2.1}}
      - {{name: eap1, kind: eap, interface: "ethernet://lan", net_id: 10.0.0.{number}.3.1}}"""
        for number, name in enumerate(("oven", "panel", "lamp"), 11)
    )
    path = tmp_path / "plant.yaml"
    path.write_text(f"plant: line\n{text}stations:{stations}\n")
    result = load(path, lambda _: ())
    assert result.findings == ()
    assert result.plant.stations[0].ports[1].interface.host == "enp3s0"


def yaml_blocks(page):
    return re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
