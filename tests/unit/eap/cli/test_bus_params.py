"""How things on a bus are written on a command line."""

from __future__ import annotations

import click
import pytest
from click.testing import CliRunner

from eap.cli.bus_params import (
    BusCommand,
    interface_option,
    number_up_to,
    open_session,
    parse_entry,
    parse_octets,
    parse_type,
    parse_uri,
    slave_argument,
)


def test_what_is_read():
    assert str(parse_uri("udp://127.0.1.1")) == "udp://127.0.1.1"
    assert parse_entry("0x1018:1") == (0x1018, 1)
    assert parse_entry("4096") == (0x1000, 0)
    assert number_up_to(255)("0xFF") == number_up_to(255)(255) == 255
    assert parse_octets("0x01ff") == b"\1\xff"
    assert parse_type("u16").text == "UINT"


@pytest.mark.parametrize(
    ("parse", "text", "reason"),
    [
        (parse_uri, "eth0", "is not an interface"),
        (parse_uri, "tcp://127.0.0.1", "not by tcp"),
        (parse_entry, "x", "such as 0x1018:1"),
        (parse_entry, "0x10000", "such as"),
        (parse_entry, "1:256", "such as"),
        (number_up_to(255), "256", "from 0 to 0xFF"),
        (number_up_to(255), "x", "from 0 to 0xFF"),
        (parse_octets, "1", "hexadecimal"),
        (parse_type, "UNIT", "did you mean UINT"),
    ],
)
def test_what_is_refused(parse, text, reason):
    with pytest.raises(click.BadParameter, match=reason):
        parse(text)


@click.command(cls=BusCommand)
@slave_argument
@interface_option
def show(slave, interface):
    click.echo(f"{slave} {interface}")


@pytest.mark.parametrize(
    "words", [["--interface", "udp://127.0.4.1"], ["--interface=udp://127.0.4.1"]]
)
def test_command_on_a_bus(words):
    assert CliRunner().invoke(show, ["a/b", *words]).output == "a/b udp://127.0.4.1\n"


@pytest.mark.parametrize(
    ("words", "reason"),
    [(["island-01/bus0", "1001"], "have no bus yet"), (["1001"], "Missing option '--interface'")],
)
def test_command_without_an_interface(words, reason):
    result = CliRunner().invoke(show, words)
    assert result.exit_code == 2
    assert reason in result.output


def test_help_needs_no_interface():
    assert CliRunner().invoke(show, ["a/b", "--help"]).exit_code == 0


@pytest.mark.net
def test_open_session():
    with open_session(parse_uri("udp://127.0.4.1")) as session:
        assert session.link_stats().sent == 0
