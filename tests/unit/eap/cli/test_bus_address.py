"""Which bus a command is about."""

from __future__ import annotations

import click
import pytest
from click.testing import CliRunner

from eap.cli.output import json_option
from eap.cli.params import (
    BusCommand,
    StationBus,
    bus_options,
    open_session,
    parse_port,
    parse_uri,
    slave_argument,
)

UDP = "udp://127.0.4.1"


@click.command(cls=BusCommand)
@bus_options
@slave_argument
@click.option("--type", "kind")
@json_option("Nothing.")
def show(bus, slave, kind, output):
    click.echo(f"{type(bus).__name__} {bus} {slave} {kind} {output.is_json}")


def invoke(*words):
    return CliRunner().invoke(show, words)


def test_ports():
    assert parse_port("press/bus0") == StationBus("press", "bus0")
    for text in ("press", "/bus0", "press/", "a/b/c", ""):
        assert parse_port(text) is None


def test_interfaces():
    assert str(parse_uri(UDP)) == UDP
    with pytest.raises(click.BadParameter, match="is not an interface"):
        parse_uri("eth0")
    with pytest.raises(click.BadParameter, match="not by tcp"):
        parse_uri("tcp://127.0.0.1")


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        (("press/bus0", "1001"), "StationBus press/bus0 1001 None False"),
        (("--json", "press/bus0", "--type", "a/b", "1001"), "StationBus press/bus0 1001 a/b True"),
        (("1001", "--interface", UDP), f"InterfaceUri {UDP} 1001 None False"),
        ((f"--interface={UDP}", "1001"), f"InterfaceUri {UDP} 1001 None False"),
        (("--type", "a/b", "--interface", UDP, "1001"), f"InterfaceUri {UDP} 1001 a/b False"),
        (("press/bus0", "--", "--interface"), "StationBus press/bus0 --interface None False"),
    ],
)
def test_both_forms(words, shown):
    result = invoke(*words)
    assert (result.exit_code, result.output) == (0, shown + "\n")


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (
            (),
            "no bus given: expected show STATION/PORT SLAVE [OPTIONS] or show --interface URI",
        ),
        (("1001",), "'1001' is not STATION/PORT"),
        (("press/bus0",), "Missing argument 'SLAVE'"),
        (("press/bus0", "1001", "--interface", UDP), "are two buses: omit one"),
        (("--type", "x", "press/bus0", "--interface", UDP, "1001"), "are two buses"),
        (("1001", "--interface", UDP, "--plant", "x"), "--plant goes with STATION/PORT"),
        (("1001", "--interface", "eth0"), "is not an interface"),
    ],
)
def test_bus_command_without_one_bus_is_refused(words, reason):
    result = invoke(*words)
    assert result.exit_code == 2
    assert reason in " ".join(result.output.split())


def test_bus_command_passes_the_plant_with_the_port():
    @click.command(cls=BusCommand)
    @bus_options
    def plant(bus):
        click.echo(bus.plant)

    assert CliRunner().invoke(plant, ["a/b", "--plant", "line"]).output == "line\n"


def test_help_shows_both_forms():
    for words in (["--help"], ["press/bus0", "--help"], ["--interface", UDP, "--help"]):
        lines = invoke(*words).output.splitlines()
        assert lines[0] == "Usage: show STATION/PORT SLAVE [OPTIONS]"
        assert lines[1] == "       show --interface URI SLAVE [OPTIONS]"


@pytest.mark.net
def test_open_session():
    with open_session(parse_uri(UDP)) as session:
        assert session.frame_counts().sent == 0


@pytest.mark.net
def test_open_session_of_a_station(bus_appliance):
    with open_session(StationBus("press", "bus0")) as session:
        assert [slave.name for slave in session.scan()] == ["coupler", "buttons", "sensor"]
