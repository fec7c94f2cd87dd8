from __future__ import annotations

import pytest

from eap.pd.spec import EoeSlaveSpec, EoeSpec

PORT = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'


def with_eoe(eoe: str) -> tuple[str, str]:
    port = "name: bus0, kind: bus, interface: sim://line.yaml, net_id: 127.0.9.1.3.1"
    return PORT, f"{PORT}\n      - {{{port}, eoe: {eoe}}}"


def eoe_of(load_plant, eoe: str) -> EoeSpec | None:
    return load_plant(with_eoe(eoe)).plant.stations[0].ports[1].eoe


def test_short_form_connects_every_slave(load_plant):
    assert eoe_of(load_plant, "tap") == EoeSpec("eoe-bus0", connects_all=True)


def test_specification_has_all_keys(load_plant):
    settings = "ip: 10.0.0.2/24, gateway: 10.0.0.1, dns: 10.0.0.3, name: v, mac: 02:00:00:00:00:01"
    text = f"{{interface: eoe0, address: 10.0.0.1/24, slaves: {{valves: {{{settings}}}}}}}"
    assert eoe_of(load_plant, text) == EoeSpec(
        "eoe0",
        "10.0.0.1/24",
        (EoeSlaveSpec("valves", "10.0.0.2/24", "10.0.0.1", "10.0.0.3", "v", "02:00:00:00:00:01"),),
    )


def test_slave_may_be_named_by_its_address(load_plant):
    assert eoe_of(load_plant, "{slaves: {1001: {}}}") == EoeSpec(
        "eoe-bus0", slaves=(EoeSlaveSpec("1001"),)
    )


def with_slaves(slaves: str, eoe: str = "") -> tuple[str, str]:
    port = "name: bus0, kind: bus, interface: sim://line.yaml, net_id: 127.0.9.1.3.1"
    return PORT, f"{PORT}\n      - {{{port}, slaves: {slaves}{eoe}}}"


def test_slave_may_have_a_key_of_its_own(load_plant):
    def loaded(*keys: str) -> EoeSpec | None:
        return load_plant(with_slaves(*keys)).plant.stations[0].ports[1].eoe

    alone = EoeSlaveSpec("valves")
    addressed = EoeSlaveSpec("valves", "10.0.0.2/24")
    assert loaded("{valves: {eoe: tap}}") == EoeSpec("eoe-bus0", slaves=(alone,))
    assert loaded("{valves: {eoe: {ip: 10.0.0.2/24}}}", ", eoe: tap") == EoeSpec(
        "eoe-bus0", slaves=(addressed,), connects_all=True
    )
    assert loaded("{valves: {optional: true}}") is None


@pytest.mark.parametrize(
    ("slaves", "eoe", "finding"),
    [
        ("{valves: {eoe: {ip: here}}}", "", "ip 'here'"),
        ("{valves: {eoe: tun}}", "", "kind is 'tun'"),
        (
            "{valves: {eoe: tap}}",
            ", eoe: {slaves: {valves: tap}}",
            "slave valves has eoe already (line 7); one of the two",
        ),
        (
            "{valves: {eoe: {ip: 10.0.0.1/24}}}",
            ", eoe: {address: 10.0.0.1/24}",
            "10.0.0.1 is used twice",
        ),
    ],
)
def test_each_mistake_at_a_slave_is_one_finding(findings, slaves, eoe, finding):
    [found] = findings(with_slaves(slaves, eoe))
    assert found.startswith(f"7: {finding}")


@pytest.mark.parametrize(
    ("eoe", "finding"),
    [
        ("tun", "kind is 'tun'; one of tap"),
        ("{interface: a/b}", "TAP interface 'a/b'"),
        ("{interface: eoe%d}", "TAP interface 'eoe%d'"),
        ("{interface: sixteen-letters0}", "TAP interface 'sixteen-letters0'"),
        ("{address: 10.0.0.1}", "address '10.0.0.1'; an IPv4 address with the length"),
        ("{address: 10.0.0.1/32}", "address '10.0.0.1/32'"),
        ("{address: 224.0.0.1/8}", "address '224.0.0.1/8'"),
        ("{slaves: {valve: {}}}", "left/bus0 has no slave 'valve', did you mean valves?"),
        ("{slaves: {valves: {ip: here}}}", "ip 'here'; an IPv4 address with the length"),
        ("{slaves: {valves: {ip: 10.0.0.2/24, gateway: x}}}", "gateway 'x'; an IPv4 address"),
        ("{slaves: {valves: {ip: 10.0.0.2/24, dns: 1}}}", "dns '1'; an IPv4"),
        ("{slaves: {valves: {ip: 10.0.0.2/24, mac: 'ff:ff:ff:ff:ff:ff'}}}", "mac 'ff:ff"),
        ("{slaves: {valves: {ip: 10.0.0.2/24, mac: '02'}}}", "mac '02'"),
        (f"{{slaves: {{valves: {{ip: 10.0.0.2/24, name: {'n' * 33}}}}}}}", "name 'nnn"),
        ("{slaves: {valves: {name: v}}}", "name is given, but no ip"),
        (
            "{address: 10.0.0.1/24, slaves: {valves: {ip: 10.0.0.1/24}}}",
            "10.0.0.1 is used twice (first in line 7)",
        ),
        ("{slave: {}}", "unknown key 'slave', did you mean slaves?"),
    ],
)
def test_each_mistake_is_one_finding(findings, eoe, finding):
    [found] = findings(with_eoe(eoe))
    assert found.startswith(f"7: {finding}")


def test_eap_port_has_no_eoe(findings):
    [found] = findings((PORT, PORT.replace("}", ", eoe: tap}")))
    assert "eoe belongs to bus ports" in found
