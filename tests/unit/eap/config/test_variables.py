from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes
from eap.config.index import Span, VariablePart
from eap.config.links import Ends, ends, execution_order, find_loops, is_bitwise, is_scaled
from eap.config.structs import LinkSection

COUNTER = "count: {kind: counter}"


def source(name, text):
    return COUNTER, f"{name}: {text}"


@pytest.mark.parametrize(
    ("edit", "finding"),
    [
        (("count: UDINT", "count: NUMBER"), "9: count: 'NUMBER' is not a data type"),
        (
            ("count: UDINT", "count: UDINT\n      a b: UINT"),
            "10: variable name 'a b'; a text without spaces",
        ),
        (("default: 2.5", "default: fast"), "8: default of speed: 'fast' is not a value of REAL"),
        (
            ("count: UDINT", "count: UDINT\n      state.VarCtrl: UINT"),
            "10: variable 'state.VarCtrl': .VarCtrl and .FrameCtrl are made by the appliance",
        ),
        (
            ("count: UDINT", "count: UDINT\n      raw: {type: BLOCK(2), default: 0011}"),
            "10: default of raw: 11 is not a value of BLOCK(2); 2 bytes in hexadecimal",
        ),
        (
            source("cuont", "{kind: counter}"),
            "11: station left has no variable 'cuont', did you mean c",
        ),
        (
            source("speed", "{kind: sine, amplitude: 1, period_ms: 0}"),
            "11: period_ms is 0; more th",
        ),
        (source("speed", "{kind: host, measure: heat}"), "11: measure is 'heat'; one of load1, lo"),
        (source("speed", "{kind: host, measure: rx_octets}"), "11: rx_octets needs an argument; a"),
        (
            source("speed", "{kind: host, measure: load1, argument: lo}"),
            "11: load1 has no argument; no argument",
        ),
        (
            source("count", "{kind: ramp, low: -1, high: 5, period_ms: 100}"),
            "11: the source goes from -1 to 5, beyond UDINT; 0 to 4.29497e+09",
        ),
        (
            source("count", "{kind: sine, offset: 1, amplitude: 2, period_ms: 100}"),
            "11: the source goes from -1 to 3, beyond UDINT",
        ),
        (
            source("count", "{kind: csv, file: no.csv, column: a}"),
            "11: no.csv: No such file or dir",
        ),
    ],
)
def test_invalid_variable_is_one_finding(findings, edit, finding):
    found = findings(edit)
    assert len(found) == 1
    assert found[0].startswith(finding)


@pytest.mark.parametrize("kind", ["BOOL", "BIT3", "STRING(4)", "BLOCK(4)", "UINT[2]"])
def test_numbers_do_not_fill_other_types(findings, kind):
    for text in ("{kind: counter}", "{kind: host, measure: load1}"):
        found = findings(("count: UDINT", f"count: UDINT\n      odd: {kind}"), source("odd", text))
        assert found == [
            f"12: odd is {kind}, this source makes numbers; a number such as UDINT or REAL"
        ]


@pytest.mark.parametrize("kind", ["BOOL", "STRING(4)", "BLOCK(4)", "UINT[2]"])
def test_random_octets_fill_every_type(load_plant, kind):
    edits = [("count: UDINT", f"count: UDINT\n      odd: {kind}"), source("odd", "{kind: random}")]
    assert load_plant(*edits).plant


def test_a_variable_has_one_writer(findings):
    found = findings(
        ("{a: REAL, b: UDINT}}", "{a: REAL, b: UDINT}}\n    sources: {a: {kind: random}}")
    )
    assert found == ["22: 'a' is received, so it cannot have a source; none (there are none here)"]


def test_a_variable_is_owned_or_received_once(findings):
    found = findings(
        ("    subscribe:", "    variables: {a: REAL}\n    subscribe:"),
    )
    assert found == ["22: variable 'a' exists already (line 20); a name of its own"]


@pytest.mark.parametrize(
    ("content", "finding"),
    [
        ("time,heat\n0,1\n1,2.5\n", None),
        (
            "time,haet\n0,1\n",
            "11: oven.csv has no column 'heat', did you mean haet?; one of time",
        ),
        ("heat\n1\nhot\n", "11: oven.csv, line 3: 'hot' is not a value of REAL"),
        ("heat\n", "11: oven.csv has no rows; at least one row"),
        ("", "11: oven.csv has no column 'heat'; none"),
        ('heat\n"1\n', "11: oven.csv: unexpected end of data; a CSV file"),
    ],
)
def test_a_csv_file_is_read_through(findings, tmp_path, content, finding):
    (tmp_path / "oven.csv").write_text(content)
    found = findings(source("speed", "{kind: csv, file: oven.csv, column: heat}"))
    assert not found if finding is None else found[0].startswith(finding), found


def test_bus_variable_cannot_have_a_source(findings):
    port = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
    bus = "{name: bus0, kind: bus, interface: sim://line.yaml, net_id: 127.0.9.1.3.1}"
    more = f"{COUNTER}\n      bus0.valves.speed: {{kind: counter}}"
    assert findings((port, f"{port}\n      - {bus}"), (COUNTER, more)) == [
        (
            "13: 'bus0.valves.speed' is on a bus, so it cannot have a source; "
            "a source for a variable of the station, and a link from that one"
        )
    ]


UINT, BOOL = datatypes.parse("UINT"), datatypes.parse("BOOL")


def way(source, target, start=0, to=0, bits=16):
    return Ends(Span(source, start, bits), Span(target, to, bits))


@pytest.mark.parametrize(
    ("keys", "source", "target", "bits"),
    [
        ({}, UINT, UINT, (0, 0, 16)),
        ({"from_bit": 3}, UINT, BOOL, (3, 0, 1)),
        ({"to_bit": 15}, BOOL, UINT, (0, 15, 1)),
        ({"from_bit": 8}, UINT, UINT, (8, 0, 8)),
        ({"from_bit": 8, "to_bit": 12, "bits": 2}, UINT, UINT, (8, 12, 2)),
    ],
)
def test_bits_are_as_many_as_both_ends_have(keys, source, target, bits):
    link = LinkSection(source="a", target="b", **keys)
    found = ends(link, VariablePart("a", source), VariablePart("b", target))
    assert (found.source.start, found.target.start, found.source.bits) == bits
    assert found.target.bits == found.source.bits
    assert is_bitwise(link) == bool(keys)


def test_a_link_computes_when_it_has_a_scale_or_an_offset():
    assert is_scaled(LinkSection(source="a", target="b", offset=0.0))
    assert is_scaled(LinkSection(source="a", target="b", scale=2.0))
    assert not is_scaled(LinkSection(source="a", target="b", swap=True))


def test_a_link_runs_behind_those_that_write_what_it_reads():
    chain = [way("c", "d"), way("b", "c"), way("x", "y"), way("a", "b")]
    assert execution_order(chain) == [2, 3, 1, 0]
    assert find_loops(chain) == []


def test_other_bits_of_a_variable_are_no_reason_to_wait():
    links = [
        way("w", "x", start=4, bits=2),
        way("a", "w", to=0, bits=4),
        way("b", "w", to=6, bits=1),
    ]
    assert execution_order(links) == [0, 1, 2]
    assert execution_order([way("w", "x", start=3, bits=2), *links[1:]]) == [1, 0, 2]


def test_shift_register_is_not_a_loop():
    links = [way("w", "w", 1, 2, 1), way("w", "w", 0, 1, 1)]
    assert execution_order(links) == [1, 0]


def test_link_loop_is_reported_in_direction_of_values():
    links = [way("behind", "end"), way("a", "b"), way("c", "a"), way("b", "c"), way("c", "behind")]
    assert execution_order(links) == []
    assert find_loops(links) == [[1, 3, 2]]
    assert find_loops([way("a", "a"), way("b", "c"), way("c", "b")]) == [[0], [1, 2]]


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=12))
def test_links_are_in_order_or_in_a_loop(pairs):
    links = [way(str(source), str(target)) for source, target in pairs]
    order, loops = execution_order(links), find_loops(links)
    assert bool(loops) == (len(order) < len(links))
    for place, position in enumerate(order):
        writers = [n for n, (_, target) in enumerate(pairs) if target == pairs[position][0]]
        assert set(writers) <= set(order[:place])
    for loop in loops:
        for position, following in zip(loop, [*loop[1:], loop[0]], strict=True):
            assert pairs[position][1] == pairs[following][0]


PORT = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
BUS = "{name: bus0, kind: bus, interface: sim://line.yaml, net_id: 127.0.9.1.3.1}"
VARIABLES = """count: UDINT
      fault: BOOL
      level: INT
      word: UINT
      heat: REAL
      text: STRING(4)
      small: USINT
      bits: BIT2"""


def linked(*links):
    """Give the left station a bus, more variables, and these links from line 21 on."""
    lines = "".join(f"\n      - {{{link}}}" for link in links)
    return (
        (PORT, f"{PORT}\n      - {BUS}"),
        ("count: UDINT", VARIABLES),
        ("      count: {kind: counter}", f"      count: {{kind: counter}}\n    links:{lines}"),
    )


@pytest.mark.parametrize(
    "link",
    [
        "from: bus0.valves.limit, to: bus0.valves.valve",
        "from: bus0.valves.limit, to: fault",
        "from: bus0.valves.state, to_bit: 8, to: word",
        "from: bus0.valves.status_word, from_bit: 3, to: fault",
        "from: fault, to: bus0.valves.speed, to_bit: 15",
        "from: text, to: word, bits: 16, from_bit: 8",
        "from: bus0.valves.status_word, to: heat, scale: 0.1, offset: -40",
        "from: heat, to: bus0.valves.speed, scale: -1",
        "from: word, to: heat, scale: 2, swap: true",
        "from: word, to: level, swap: true",
        "from: word, to: level, swap: true, scale: 1, offset: 1",
        "from: word, to: heat, swap: true, scale: 1",
        "from: word, to: word, from_bit: 0, to_bit: 8, bits: 8",
        "from: bits, to: level, offset: 1",
        "from: speed, to: heat",
    ],
)
def test_these_links_run(findings, link):
    assert findings(*linked(link)) == []


@pytest.mark.parametrize(
    ("link", "finding"),
    [
        (
            "from: falt, to: fault",
            "station left has no variable 'falt', did you mean fault?; one",
        ),
        (
            "from: bus0.valves.limits, to: fault",
            "station left has no variable 'bus0.valves.limits', did you mean bus0.valves.limit?",
        ),
        (
            "from: fault, to: bus0.valve.valve",
            "station left has no variable 'bus0.valve.valve', did",
        ),
        ("from: fault, to: state.VarCtrl", "station left has no variable 'state.VarCtrl'"),
        ("from: fault", "item 1 of links has no to; the key to"),
        ("from: a, too: fault", "unknown key 'too', did you mean to"),
        ("from: word, to: level", "word is UINT, level is INT; both alike, or bits: 16, scale or"),
        ("from: word, to: fault", "word is UINT, fault is BOOL; both alike, or bits: 1"),
        (
            "from: fault, to: count, bits: 1",
            "'count' has a source (line 19), so no link can write it; a vari",
        ),
        ("from: fault, to: bus0.valves.limit", "'bus0.valves.limit' comes from a bus, so no link"),
        ("from: fault, to: bus0.wkc_ok", "'bus0.wkc_ok' comes from a bus, so no link can write it"),
        ("from: word, from_bit: 16, to: fault", "word is UINT and has no bit 16; 0 to 15"),
        ("from: fault, to_bit: 16, to: word", "word is UINT and has no bit 16; 0 to 15"),
        (
            "from: word, from_bit: 12, bits: 5, to: level",
            "word is UINT and has no 5 bits from bit 12 on; at most 4",
        ),
        (
            "from: word, bits: 2, to: fault",
            "fault is BOOL and has no 2 bits from bit 0 on; at most",
        ),
        ("from: word, bits: 0, to: fault", "bits is 0; a whole number from 1 to 524280"),
        ("from: word, from_bit: -1, to: fault", "from_bit is -1; a whole number from 0 to 524279"),
        (
            "from: word, from_bit: 1, scale: 2, to: heat",
            "the link copies bits and has a scale; one",
        ),
        (
            "from: word, bits: 8, swap: true, to: level",
            "the link copies bits and has a swap; one of",
        ),
        ("from: text, scale: 2, to: heat", "text is STRING(4), heat is REAL; numbers such as INT"),
        (
            "from: word, offset: 2, to: fault",
            "word is UINT, fault is BOOL; numbers such as INT or ",
        ),
        ("from: word, scale: 0, to: heat", "scale is 0; another number"),
        ("from: word, scale: .nan, to: heat", "scale is nan; a number"),
        (
            "from: small, to: bus0.valves.speed, swap: true",
            "small is USINT, bus0.valves.speed is INT",
        ),
        (
            "from: small, to: word, swap: true, scale: 1",
            "small is USINT, word is UINT; a source of",
        ),
        (
            "from: word, to: level, swap: true, scale: 1",
            "word is UINT, level is INT: a swap with scale 1 computes nothing; swap alone to copy",
        ),
        (
            "from: word, to: level, swap: true, offset: 0",
            "word is UINT, level is INT: a swap with offset 0 computes nothing; swap alone",
        ),
        (
            "from: fault, to: bits, swap: true",
            "fault is BOOL, bits is BIT2; two variables of the same",
        ),
        ("from: level, to: level", "links form a loop: level → level; one of them to be left"),
    ],
)
def test_invalid_link_is_one_finding(findings, link, finding):
    found = findings(*linked(link))
    assert len([each for each in found if each.startswith(f"21: {finding}")]) == 1, found
    assert len(found) == 1 or "unknown key" in finding


def test_a_received_variable_is_no_target(findings):
    old = "timeout_ms: 50, variables: {a: REAL, b: UDINT}}"
    links = "\n    variables: {c: REAL}\n    links: [{from: c, to: a}]"
    assert findings((old, old + links)) == [
        (
            "23: 'a' is received, so no link can write it; "
            "a variable of the station's own, or an output of a bus"
        )
    ]


def test_a_variable_is_linked_once_or_bit_by_bit(findings):
    bits = ["from: fault, to: word, to_bit: 1", "from: bus0.valves.limit, to: word, to_bit: 2"]
    assert findings(*linked(*bits)) == []
    twice = "from: bits, to: word, to_bit: 2"
    assert findings(*linked(*bits, twice)) == [
        (
            "23: 'word' is linked twice (first in line 22); "
            "one link for each variable, or for each bit of it"
        )
    ]


def test_loops_are_reported(findings):
    links = ["from: word, to: level, scale: 1", "from: fault, to: bus0.valves.lamp"]
    back = "from: level, to: word, swap: true"
    assert findings(*linked(*links, back)) == [
        "21: links form a loop: word → level → word; one of them to be left out"
    ]


def test_unknown_type_is_reported_once(findings):
    found = findings(*linked("from: heat, to: word"), ("heat: REAL", "heat: REEL"))
    assert [each[:12] for each in found] == ["14: heat: 'R"]
