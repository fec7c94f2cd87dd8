"""``eapctl sim fault`` and ``sim set``."""

from __future__ import annotations

import json

import click
import pytest

from devicebus.sim.spec import FaultKind
from eap.cli.group import main
from eap.cli.sim import parse_fault, parse_value


@pytest.fixture
def command(capsys):
    """Run one command; return its exit code, stdout and stderr."""

    def run(*words):
        with pytest.raises(SystemExit) as end:
            main(["sim", *words], prog_name="eapctl")
        return end.value.code, *capsys.readouterr()

    return run


def test_faults_in_words_and_in_json():
    words = ("power", "slave=drive", "for-ms=500", "drift_ppm=1.5", "code=0x51")
    expected = {"kind": "power", "slave": "drive", "for_ms": 500, "drift_ppm": 1.5, "code": 0x51}
    assert parse_fault(words) == expected
    assert parse_fault((json.dumps(expected),)) == expected
    object_ = parse_fault(("tx-pdo", "object=0x1A00", "slave=7"))
    assert object_ == {"kind": "tx-pdo", "object": "0x1A00", "slave": "7"}
    for wrong in (("power", "slave"), ("power", "=1"), ("{",), ("{1}",)):
        with pytest.raises(click.UsageError):
            parse_fault(wrong)


def test_help_names_every_kind(command):
    code, out, _ = command("fault", "--help")
    words = out.replace(",", " ").replace(";", " ").split()
    assert code == 0
    assert [kind for kind in FaultKind if kind.value not in words] == []


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("true", True),
        ("false", False),
        ("7", 7),
        ("-7", -7),
        ("0x10", 16),
        ("1.5", 1.5),
        ("a", "a"),
    ],
)
def test_values(text, value):
    assert parse_value(text) == value
    assert type(parse_value(text)) is type(value)


@pytest.mark.net
def test_fault_begins_and_ends(bus_appliance, command):
    segment = bus_appliance.lines[0].segment
    assert command("fault", "press/bus0", "loss", "every=3") == (
        0,
        "press/bus0: fault loss started\n",
        "",
    )
    assert segment._on_frames
    out = command("fault", "press/bus0", "loss", "every=3", "--end", "--json")[1]
    assert json.loads(out) == {"kind": "loss", "every": 3, "end": True}
    assert not segment._on_frames


@pytest.mark.net
def test_value_is_kept_and_released(bus_appliance, command):
    code, out, _ = command("set", "press/bus0", "buttons", "start", "true")
    assert (code, out) == (0, "press/bus0: buttons start = true\n")
    out = command("set", "press/bus0", "sensor", "0x6000:1", "-5", "--json")[1]
    entry = {"slave": "sensor", "entry": "0x6000:1"}
    assert json.loads(out) == {"set": entry | {"value": -5}}
    out = command("set", "press/bus0", "sensor", "0x6000:1", "--release")[1]
    assert out == "press/bus0: sensor 0x6000:1 released\n"


@pytest.mark.net
@pytest.mark.parametrize(
    ("words", "code", "reason"),
    [
        (("fault", "press/bus0", "powr"), 1, "no fault 'powr', did you mean power? (one of loss"),
        (("fault", "press/bus0", "power", "slave=x"), 1, "no slave 'x' (one of coupler"),
        (("fault", "press/eap0", "loss"), 1, "port eap0 of station press is no bus"),
        (("fault", "press", "loss"), 2, "'press' is not STATION/PORT, such as press/bus0"),
        (("fault", "press/bus0"), 2, "Missing argument"),
        (("set", "press/bus0", "buttons", "x", "1"), 1, "buttons has no entry 'x'"),
        (("set", "press/bus0", "buttons", "start"), 2, "expected one of VALUE and --release"),
        (("set", "press/bus0", "buttons", "start", "1", "--release"), 2, "expected one of"),
    ],
)
def test_refusals(bus_appliance, command, words, code, reason):
    got, out, err = command(*words)
    assert (got, out) == (code, "")
    assert reason in err
