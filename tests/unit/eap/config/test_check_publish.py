from __future__ import annotations

import pytest

PD = "id: 1, version: 3,"
FRAME = "to: 127.0.9.2}"
TIMEOUT = "timeout_ms: 50, "


def pd(text):
    return PD, f"id: 1, version: 3, {text},"


def frame(text):
    return FRAME, f"to: 127.0.9.2, {text}}}"


@pytest.mark.parametrize(
    ("edits", "finding"),
    [
        (
            [("out, port: eap0", "out, port: eap1")],
            "13: station left has no port 'eap1', did you m",
        ),
        ([("frame: out", "frame: uot")], "15: station left has no frame 'uot', did you mean out"),
        ([("[speed, count]", "[sped, count]")], "15: station left has no variable 'sped', did you"),
        ([("[speed, count]", "[]")], "15: PD 'state' has no variables; at least one"),
        (
            [("name: out", "name: o ut"), ("frame: out", "frame: o ut")],
            "13: frame name 'o ut'; a t",
        ),
        (
            [("to: 127.0.9.2", "to: ethernet")],
            "13: destination of frame 'out': 'ethernet' is not a",
        ),
        (
            [("to: 127.0.9.2", "to: multicast")],
            "13: destination of frame 'out': multicast has no u",
        ),
        (
            [("to: 127.0.9.2", "to: rigth/eap0")],
            "13: destination of frame 'out': rigth/eap0 is no ",
        ),
        (
            [pd("cycle_us: 15000")],
            "15: cycle_us 15000 of PD 'state' is no multiple of the device c",
        ),
        (
            [pd("cycle_us: 20000, divider: 2")],
            "15: PD 'state' has a cycle_us and a divider; one of",
        ),
        ([pd("modulo: 1")], "15: 'state' has a modulo but no divider; both or none"),
        ([pd("divider: 2, modulo: 2")], "15: modulo 2 of 'state' never comes up; less than the di"),
        ([frame("modulo: 1")], "13: 'out' has a modulo but no divider; both or none"),
        (
            [pd("cycle_us: 20000, on_change: {}")],
            "15: PD 'state' is sent on change and has a cycle_us; on_change.timeout_ms for sending",
        ),
        (
            [pd("divider: 2, on_change: {}")],
            "15: PD 'state' is sent on change and has a divider; o",
        ),
        ([pd("on_change: true")], "15: on_change is True; a mapping"),
        ([pd("on_change: {timeout_ms: -1}")], "15: timeout_ms is -1; 0 (off) to 4294967295"),
        (
            [pd("on_change: {timeout_ms: 1, inhibit_us: 1001}")],
            "15: PD 'state' is to be sent again before changes may be; timeout_ms of at least 2",
        ),
        (
            [frame("divider: 4"), pd("divider: 6")],
            "15: PD 'state' is due every 6 cycles, but frame 'out' leaves only every 4 cycles (lin",
        ),
        (
            [frame("divider: 4"), pd("cycle_us: 60000")],
            "15: PD 'state' is due every 6 cycles, but frame 'out' leaves only every 4 cycles (lin",
        ),
        (
            [frame("divider: 4, modulo: 1"), pd("divider: 8, modulo: 4")],
            "15: PD 'state' is due at 4 of 8 cycles, but frame 'out' leaves only every 4 cycles (l",
        ),
        (
            [frame("divider: 4, modulo: 1"), pd("cycle_us: 80000")],
            "15: PD 'state' is due at 0 of 8 cycles, but frame 'out' leaves only every 4 cycles",
        ),
        (
            [(FRAME, f"{FRAME}\n      - {{name: idle, port: eap0, to: 127.0.9.2}}")],
            "14: frame 'idle' carries no PD; a PD under publish with frame: idle",
        ),
    ],
)
def test_what_cannot_be_sent_so_is_a_finding_of_its_line(findings, edits, finding):
    found = findings(*edits)
    assert found[0].startswith(finding)


@pytest.mark.parametrize(
    "edits",
    [
        [pd("cycle_us: 20000, event: true")],
        [pd("on_change: {}, event: true")],
        [pd("on_change: {timeout_ms: 20, inhibit_us: 20000}")],
        [pd("event: true")],
        [frame("divider: 4, modulo: 1"), pd("divider: 8, modulo: 5")],
        [frame("divider: 4"), pd("cycle_us: 80000")],
        [frame("divider: 4, modulo: 3")],
        [frame("divider: 4, modulo: 3"), pd("on_change: {}")],
    ],
)
def test_triggers_that_go_together_pass(load_plant, edits):
    assert load_plant((TIMEOUT, ""), *edits).plant


def test_pd_ids_are_unique_for_each_publisher(findings, load_plant):
    second = "\n      - {name: more, frame: out, id: 1, variables: [count]}"
    old = "variables: [speed, count]}"
    [finding] = findings((old, old + second))
    assert finding.startswith(
        "16: PD id 1 is used twice by publisher 127.0.9.1.2.1 (first in line 15); an id of its own"
    )
    port = "net_id: 127.0.9.1.2.1}"
    other = '\n      - {name: eap1, kind: eap, interface: "udp://127.0.9.3", net_id: 127.0.9.1.3.1}'
    away = "\n      - {name: away, port: eap1, to: 127.0.9.2}"
    assert load_plant(
        (port, port + other),
        (FRAME, FRAME + away),
        (old, old + second.replace("frame: out", "frame: away")),
    ).plant


BUDGETS = [
    ("udp://127.0.9.1", "udp://127.0.9.2", "127.0.9.2", 1450),
    ("udp://127.0.9.1", "udp://127.0.9.2", "239.1.1.1", 1450),
    ("ethernet://eth0", "ethernet://eth0", "multicast", 1478),
    ("tcp://127.0.9.1", "tcp://127.0.9.2", "right/eap0", 2027),
    ("loop://line", "loop://line", "right/eap0", 2027),
]


@pytest.mark.parametrize(("left", "right", "to", "largest"), BUDGETS)
def test_a_frame_is_as_large_as_its_wire_allows(findings, left, right, to, largest):
    edits = [
        ('"udp://127.0.9.1"', f'"{left}"'),
        ('"udp://127.0.9.2"', f'"{right}"'),
        ("to: 127.0.9.2", f"to: {to}"),
        ("    sources:\n      count: {kind: counter}\n", ""),
        ("[speed, count]", "[count]"),
    ]
    sizes = [("count: UDINT", "count: BLOCK({})"), ("{a: REAL, b: UDINT}", "{{b: BLOCK({})}}")]
    fitting = [(old, new.format(largest)) for old, new in sizes]
    assert findings(*edits, *fitting) == []
    [finding] = findings(*edits, *((old, new.format(largest + 1)) for old, new in sizes))
    total = largest + 23
    assert finding.startswith(
        f"11: frame 'out' has {total} octets with its 1 PDs; at most {total - 1}"
    )


def test_the_budget_counts_every_pd_of_a_frame(findings):
    old = "variables: [speed, count]}"
    more = "".join(
        f"\n      - {{name: pd{n}, frame: out, id: {n}, variables: [big]}}" for n in (2, 3)
    )
    size = [("count: UDINT", "count: UDINT\n      big: BLOCK(720)"), (old, old + more)]
    [finding] = findings(*size)
    assert finding.startswith("14: frame 'out' has 1486 octets with its 3 PDs; at most 1472 to 127")


def test_frames_leave_by_eap_ports(findings):
    bus = "{name: bus0, kind: bus, interface: sim://b.yaml, net_id: 127.0.9.1.3.1}"
    found = findings(
        ("net_id: 127.0.9.1.2.1}", f"net_id: 127.0.9.1.2.1}}\n      - {bus}"),
        ("out, port: eap0", "out, port: bus0"),
    )
    assert "14: port bus0 is a bus port; one of eap0" in found


def test_near_names_include_what_is_received(findings):
    old = "timeout_ms: 50, variables: {a: REAL, b: UDINT}}"
    relay = """
    frames: [{name: back, port: eap0, to: left/eap0}]
    publish: [{name: echo, frame: back, id: 1, variables: [seen.speeed]}]"""
    [finding] = findings((old, "timeout_ms: 50}" + relay))
    assert finding.startswith(
        "23: station right has no variable 'seen.speeed', did you mean seen.s"
    )


def test_a_received_variable_may_be_sent_again(load_plant):
    old = "timeout_ms: 50, variables: {a: REAL, b: UDINT}}"
    relay = """
    frames: [{name: back, port: eap0, to: left/eap0}]
    publish: [{name: echo, frame: back, id: 1, variables: [%s]}]"""
    assert load_plant((old, old + relay % "b, a")).plant
    taken_over = load_plant((old, "timeout_ms: 50}" + relay % "seen.count, seen.speed")).plant
    assert taken_over.stations[1].frames[0].pds[0].variables == ("seen.count", "seen.speed")


def test_what_is_on_a_bus_may_be_sent(findings):
    port = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
    bus = "{name: bus0, kind: bus, interface: sim://line.yaml, net_id: 127.0.9.1.3.1}"

    def sent(name, *more):
        return findings((port, f"{port}\n      - {bus}"), ("[speed, count]", name), *more)

    free = ("{a: REAL, b: UDINT}", "{a: BOOL}")
    assert sent("[bus0.valves.limit]", free) == []
    found = sent("[bus0.valves.limits]")
    assert found[0].startswith(
        "16: station left has no variable 'bus0.valves.limits', did you mean bus0.valves.limit?"
    )
    assert sent("[bus0.valves.state, bus0.valves.speed]") == [
        "22: a is REAL, but left/state sends bus0.valves.state as BYTE (line 16); BYTE",
        "22: b is UDINT, but left/state sends bus0.valves.speed as INT (line 16); INT",
    ]
    assert len(sent("[bus0.valves.limit]", ("line.yaml", "broken.yaml"))) == 1
