"""``eapctl gw``: the commands of a bus, through a gateway."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

from eap.cli.group import main
from eap.gateway.client import GatewayClient
from tests.support.fakegateway import FILE, FakeGateway

pytestmark = pytest.mark.net


@pytest.fixture(scope="module")
def gateway():
    with FakeGateway() as running:
        yield running


def run(gateway: FakeGateway, *arguments: str, options: tuple[str, ...] = ()):
    words = ["gw", *options, f"127.0.0.1:{gateway.port}", *arguments]
    return CliRunner().invoke(main, words, catch_exceptions=False)


@pytest.mark.parametrize("options", [(), ("--tcp",)])
def test_objects_are_read_and_written(gateway, options) -> None:
    assert run(gateway, "sdo", "write", "drive", "0x2000", "5", options=options).exit_code == 0
    found = run(gateway, "sdo", "read", "1001", "0x2000", "--json", options=options)
    assert json.loads(found.output)["value"] == 5
    master = run(gateway, "sdo", "read", "0", "0x1008", options=options)
    assert master.output.endswith(" M\n")


@pytest.mark.parametrize("words", [("--tcp", "scan"), ("scan", "--tcp")])
def test_tcp_may_stand_behind_the_host(gateway, words, monkeypatch) -> None:
    opened = []
    monkeypatch.setattr(
        "eap.ops.bus_gateway.GatewayClient",
        lambda *place, tcp: opened.append(tcp) or GatewayClient(*place, tcp=tcp),
    )
    assert run(gateway, *words).exit_code == 0
    assert opened == [True]


@pytest.mark.parametrize("option", [("--mailbox", "140"), ("--mailbox=140",)])
def test_mailbox_option_is_accepted_after_the_host(gateway, option, tmp_path) -> None:
    refused = run(gateway, "foe", "get", "7", "f", str(tmp_path / "f"))
    assert (refused.exit_code, "use --mailbox BYTES" in refused.output) == (1, True)
    asked = run(gateway, "foe", "get", "7", "f", str(tmp_path / "f"), *option)
    assert "UNSUPPORTED_PROTOCOL" in asked.output
    assert "address 7 is not a slave of this bus (1001 (drive))" in asked.output
    assert run(gateway, "scan", "--mailbox").exit_code == 2
    assert run(gateway, "voe", "drive", "--vendor", "1", "--", "--tcp").exit_code == 2


def test_scan(gateway) -> None:
    found = json.loads(run(gateway, "scan", "--json").output)
    assert [slave["name"] for slave in found["slaves"]] == ["drive"]


def test_files(gateway, tmp_path) -> None:
    source, target = tmp_path / "a", tmp_path / "b"
    source.write_bytes(FILE)
    assert run(gateway, "foe", "put", "1001", str(source), "f").exit_code == 0
    assert run(gateway, "foe", "get", "1001", "f", str(target)).exit_code == 0
    assert target.read_bytes() == FILE


def test_idns_and_vendors_protocols(gateway) -> None:
    assert "S-0-0032 = 7" in run(gateway, "idn", "read", "1001", "S-0-0032").output
    found = run(gateway, "voe", "1001", "0102", "--vendor", "0x1164", "--vendor-type", "1")
    assert found.output == "0102\n"


def test_help_names_the_gateway_and_no_bus(gateway) -> None:
    text = run(gateway, "sdo", "read", "--help").output
    assert "HOST[:PORT] sdo read [OPTIONS] SLAVE INDEX[:SUB]" in text
    assert "--interface" not in text
    assert "--plant" not in text


def test_help_behind_the_host_is_that_of_all_commands(gateway) -> None:
    text = run(gateway, "--help").output
    assert "HOST[:PORT] COMMAND [ARGS]..." in text
    assert "Show all objects of the master or a slave as a tree." in text


@pytest.mark.parametrize("place", ["a:b", ":5", "a:0", "a:70000"])
def test_places_that_are_none(place) -> None:
    found = CliRunner().invoke(main, ["gw", place, "scan"])
    assert found.exit_code == 2
    assert "is not HOST[:PORT], such as" in found.output
