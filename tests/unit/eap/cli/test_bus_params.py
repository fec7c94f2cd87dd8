"""Notation of bus parameters on the command line."""

from __future__ import annotations

import click
import pytest

from eap.cli.params import number_up_to, parse_entry, parse_octets, parse_type


def test_read_entries_have_type_and_value():
    assert parse_entry("0x1018:1") == (0x1018, 1)
    assert parse_entry("1000:0") == (0x1000, 0)
    assert number_up_to(255)("0xFF") == number_up_to(255)(255) == 255
    assert parse_octets("0x01ff") == b"\1\xff"
    assert parse_type("u16").text == "UINT"


@pytest.mark.parametrize(
    ("parse", "text", "reason"),
    [
        (parse_entry, "x", "such as 0x1018:01"),
        (parse_entry, "0x10000", "such as"),
        (parse_entry, "1:100", "such as"),
        (number_up_to(255), "256", "from 0 to 0xFF"),
        (number_up_to(255), "x", "from 0 to 0xFF"),
        (parse_octets, "1", "hexadecimal"),
        (parse_type, "UNIT", "did you mean UINT"),
    ],
)
def test_refused_requests_are_reported(parse, text, reason):
    with pytest.raises(click.BadParameter, match=reason):
        parse(text)
