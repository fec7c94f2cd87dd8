from __future__ import annotations

import pytest

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
            "10: default of raw: 11 is not a value of BLOCK(2); 2 octets in hexadecimal",
        ),
        (source("cuont", "{kind: counter}"), "11: 'cuont' is no variable of left, did you mean c"),
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
def test_a_variable_that_cannot_be_is_one_finding(findings, edit, finding):
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


def test_what_is_on_a_bus_has_no_source(findings):
    port = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
    bus = "{name: bus0, kind: bus, interface: sim://line.yaml, net_id: 127.0.9.1.3.1}"
    more = f"{COUNTER}\n      bus0.valves.speed: {{kind: counter}}"
    assert findings((port, f"{port}\n      - {bus}"), (COUNTER, more)) == [
        (
            "13: 'bus0.valves.speed' is on a bus, so it cannot have a source; "
            "a source for a variable of the station, and a link from that one"
        )
    ]
