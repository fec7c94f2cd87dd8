from __future__ import annotations

import pytest

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
        ("from: word, to: fault", "word is UINT, fault is BOOL; both alike, or bits: 1, scale"),
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
        ("from: fault, to: bits, swap: true", "fault is BOOL, bits is BIT2; two variables of as"),
        ("from: level, to: level", "links go in a circle: level → level; one of them to be left"),
    ],
)
def test_a_link_that_cannot_run_is_one_finding(findings, link, finding):
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


def test_circles_are_named(findings):
    links = ["from: word, to: level, scale: 1", "from: fault, to: bus0.valves.lamp"]
    back = "from: level, to: word, swap: true"
    assert findings(*linked(*links, back)) == [
        "21: links go in a circle: word → level → word; one of them to be left out"
    ]


def test_variables_with_an_unknown_type_are_blamed_once(findings):
    found = findings(*linked("from: heat, to: word"), ("heat: REAL", "heat: REEL"))
    assert [each[:12] for each in found] == ["14: heat: 'R"]
