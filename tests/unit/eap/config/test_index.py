from __future__ import annotations

import pytest

from eap.config.index import parse_types
from eap.config.structs import FromSection
from eap.ids import NetId

PD = "id: 1, version: 3,"
PORT = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
BUS = "{name: bus0, kind: bus, interface: sim://line.yaml, net_id: 127.0.9.1.3.1}"
VARIABLES = ", variables: {a: REAL, b: UDINT}}"


def test_parts_are_found_by_name(index):
    plant = index()
    assert plant.uris["right", "eap0"].host == "127.0.9.2"
    assert plant.sent["left", "state"].label == "left/state"
    assert plant.ports["left", "eap0"] is plant.sent["left", "state"].port


def test_of_two_with_one_name_the_first_counts(index):
    plant = index(("name: right", "name: left"))
    assert plant.stations["left"].net_id == NetId.parse("127.0.9.1.1.1")


def test_a_publisher_is_found_by_name_by_numbers_or_by_id_alone(index):
    plant = index()
    subscription = plant.stations["right"].subscribe[0]
    assert [sent.label for sent in plant.publishers(subscription)] == ["left/state"]
    for publisher, pd_id, found in (
        ("127.0.9.1.2.1", 1, 1),
        ("any", 1, 1),
        ("any", 2, 0),
        ("127.0.9.2.2.1", 1, 0),
    ):
        source = FromSection(publisher=publisher, id=pd_id)
        other = type(subscription)(name="x", port="eap0", source=source)
        assert len(plant.publishers(other)) == found


def test_variables_are_taken_over_with_the_name_of_the_subscription(index):
    plant = index((VARIABLES, "}"))
    right = plant.stations["right"]
    assert plant.received(right.subscribe[0]) == {"seen.speed": "REAL", "seen.count": "UDINT"}
    assert plant.type_text(right, "seen.count") == "UDINT"
    assert plant.type_text(right, "seen.other") is None
    assert plant.type_text(right, "count") is None


def test_forwarded_variable_keeps_its_type_and_a_loop_ends(index):
    relay = """}
    frames: [{name: back, port: eap0, to: left/eap0}]
    publish: [{name: echo, frame: back, id: 1, variables: [seen.count, seen.back.x]}]"""
    back = "\n    subscribe: [{name: back, port: eap0, from: right/echo}]\n  - name: right"
    plant = index(
        (VARIABLES, relay),
        ("\n  - name: right", back),
        ("[speed, count]", "[back.seen.count, count]"),
    )
    left = plant.stations["left"]
    assert plant.type_text(left, "back.seen.count") == "UDINT"
    assert plant.type_text(left, "back.seen.back.x") is None


@pytest.mark.parametrize(
    ("triggers", "gate", "step"),
    [
        ("", "", 1),
        (" cycle_us: 60000,", "", 6),
        (" divider: 4,", "", 4),
        ("", ", divider: 5", 5),
        (" divider: 10,", ", divider: 5", 10),
        (" on_change: {},", "", 0),
        (" event: true,", "", 0),
        (" cycle_us: 60000, event: true,", "", 0),
    ],
)
def test_a_step_is_known_where_the_sender_is_regular(index, triggers, gate, step):
    plant = index((PD, PD + triggers), ("to: 127.0.9.2", f"to: 127.0.9.2{gate}"))
    assert plant.step(plant.sent["left", "state"]) == step


def test_types_are_all_or_none():
    assert [kind.text for kind in parse_types(["U16", "real"])] == ["UINT", "REAL"]
    assert parse_types(["UINT", None]) is None
    assert parse_types(["UINT", "NUMBER"]) is None


def test_forwarded_bus_variables_keep_their_types(index):
    plant = index(
        (PORT, f"{PORT}\n      - {BUS}"),
        (VARIABLES, "}"),
        ("[speed, count]", "[speed, bus0.valves.status_word, bus0.valves.state]"),
    )
    left, right = plant.stations["left"], plant.stations["right"]
    assert plant.type_text(left, "bus0.valves.limit") == "BOOL"
    assert plant.type_text(left, "bus0.valves.none") is None
    assert plant.type_text(right, "seen.bus0.valves.status_word") == "UINT"
    assert plant.names(right) == [
        "seen.speed",
        "seen.bus0.valves.status_word",
        "seen.bus0.valves.state",
    ]
    assert plant.names(left)[:4] == ["speed", "count", "bus0.state", "bus0.wkc_ok"]
    assert plant.bus_variables(right) == {}
    assert plant.unread_buses(left) == []


def test_index_lists_buses_without_description(index):
    plant = index((PORT, f"{PORT}\n      - {BUS.replace('line', 'none')}"))
    assert plant.unread_buses(plant.stations["left"]) == ["bus0"]
    assert plant.unread_buses(plant.stations["right"]) == []
    assert plant.buses == {}
