from __future__ import annotations

import re

import pytest

from eap.config.hosts import parse_host, why_unreadable


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [
        ("192.168.1.5", "192.168.1.5", 48898),
        ("192.168.1.5:4000", "192.168.1.5", 4000),
        ("plc", "plc", 48898),
        ("plc-3.line_1.example:1", "plc-3.line_1.example", 1),
    ],
)
def test_a_host_has_a_name_or_an_address(text, host, port):
    assert parse_host(text, 48898) == (host, port)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "'' is no name of a host"),
        ("-a", "'-a' is no name of a host"),
        ("a b", "'a b' is no name of a host"),
        ("a..b", "'a..b' is no name of a host"),
        ("a" * 64, "is no name of a host"),
        (".".join(["abcdefgh"] * 29), "is no name of a host"),
        ("1.2.3", "'1.2.3' is not the IPv4 address of a host"),
        ("1.2.3.256", "'1.2.3.256' is not the IPv4 address of a host"),
        ("239.1.1.1", "is not the IPv4 address of a host"),
        ("0.0.0.0", "is not the IPv4 address of a host"),
        ("255.255.255.255", "is not the IPv4 address of a host"),
        ("plc:0", "'0' is not a port (1 to 65535)"),
        ("plc:65536", "'65536' is not a port (1 to 65535)"),
        ("plc:", "'' is not a port (1 to 65535)"),
        ("::1", "is not a port"),
    ],
)
def test_what_is_no_host_says_why(text, reason):
    with pytest.raises(ValueError, match=re.escape(reason)):
        parse_host(text, 1)


def test_a_file_is_readable_or_says_why_not(tmp_path):
    (tmp_path / "secret").touch()
    assert why_unreadable(tmp_path / "secret") == ""
    assert why_unreadable(tmp_path / "gone") == "No such file or directory"
    assert why_unreadable(tmp_path) == "Is a directory"
    assert "null" in why_unreadable(tmp_path / "a\0b")
