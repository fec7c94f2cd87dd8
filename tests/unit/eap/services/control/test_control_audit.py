"""Audit of requests by the control socket."""

from __future__ import annotations

from typing import Any

import pytest

from eap.control.bus import BusOpenParameters, MailboxData
from eap.control.device import ApplyAnswer, StateAnswer, StateError
from eap.control.protocol import Request
from eap.services.control.audit import change_of, error_in_result


def opened(protocol: str = "coe") -> BusOpenParameters:
    return BusOpenParameters(station="left", port="bus0", slave=1001, protocol=protocol)


def told(method: str, protocol: str = "coe", **params: Any) -> tuple[str, dict[str, Any]] | None:
    return change_of(Request(v=1, id=1, method=method, params=params), lambda _: opened(protocol))


@pytest.mark.parametrize("method", ["hello", "status", "od_read", "bus_describe", "plan"])
def test_change_of_a_read_is_none(method: str) -> None:
    assert told(method, station="left") is None


def test_change_has_no_secrets_and_short_values() -> None:
    found = told("routes_add_remote", station="left", address="10.0.0.5", password="p")
    assert found == ("left", {"operation": "routes_add_remote", "asked": {"address": "10.0.0.5"}})
    found = told("od_write", target="left/eap0", index=0x8000, subindex=1, data="00" * 200)
    assert found is not None
    assert found[0] == "left"
    assert found[1]["asked"]["index"] == 0x8000
    assert found[1]["asked"]["data"] == "0" * 200 + "…"
    assert told("stop") == ("", {"operation": "stop", "asked": {}})


def test_change_of_datagrams_with_a_write() -> None:
    read, write = [4, 1001, 304, "0000", 1], [5, 1001, 288, "0800", 1]
    assert told("bus_transfer", station="left", port="bus0", datagrams=[read]) is None
    assert told("bus_transfer", station="left", port="bus0", datagrams="what") is None
    assert told("bus_transfer", station="left", port="bus0", datagrams=[read, write]) is not None
    read_eeprom = [[5, 1001, 0x500, "00", 3], [5, 1001, 0x502, "000104000000", 3]]
    assert told("bus_transfer", station="left", port="bus0", datagrams=read_eeprom) is None
    write_eeprom = [5, 1001, 0x502, "0102040000000000", 3]
    assert told("bus_transfer", station="left", port="bus0", datagrams=[write_eeprom]) is not None


@pytest.mark.parametrize(
    ("protocol", "request_", "words"),
    [
        ("coe", "00202300800132000000", {"object": "0x8000:01", "length": 4, "value": "32000000"}),
        ("soe", "034020000a000000", {"operation": "Write", "value": "0a000000"}),
        ("foe", "020000000000612e62696e", {"file": "a.bin"}),
        ("voe", "341200000100", {"operation": "ReadWrite"}),
    ],
)
def test_change_of_a_slave(protocol: str, request_: str, words: dict) -> None:
    found = told("bus_ask", protocol, conversation=1, request=request_)
    assert found is not None
    assert found[0] == "left"
    assert found[1] == found[1] | words | {"name": "left/bus0/1001"}
    assert told("bus_ask", protocol, conversation=1, request=request_, listen=True) is None


@pytest.mark.parametrize(
    ("protocol", "request_"),
    [
        ("coe", "00204018100100000000"),
        ("coe", "002000" + "00" * 7),
        ("soe", "01402000"),
        ("foe", "010000000000612e62696e"),
        ("foe", "030001000000ffff"),
        ("coe", "xx"),
    ],
    ids=["upload", "segment", "IDN", "open for read", "packet", "no digits"],
)
def test_change_of_reads_and_steps_of_a_conversation_is_none(protocol: str, request_: str) -> None:
    assert told("bus_ask", protocol, conversation=1, request=request_) is None


def test_a_conversation_that_is_not_open() -> None:
    request = Request(v=1, id=1, method="bus_ask", params={"conversation": "x"})
    assert change_of(request, lambda _: opened()) is None


@pytest.mark.parametrize(
    ("result", "text"),
    [
        ({}, ""),
        ([], ""),
        (StateAnswer("OP", None), ""),
        (StateAnswer("PREOP", StateError(1, "PD has no PDO")), "PD has no PDO"),
        (ApplyAnswer(False, [], [], ["a", "b"]), "a; b"),
    ],
)
def test_refusals_that_are_results(result: Any, text: str) -> None:
    assert error_in_result(result) == text


@pytest.mark.parametrize(
    ("protocol", "data", "is_error"),
    [
        ("coe", "00308018100102000106", True),
        ("coe", "00306018100100000000", False),
        ("soe", "144020000470", True),
        ("foe", "05000180000078", True),
        ("foe", "040000000000", False),
        ("voe", "3412000001000102", False),
    ],
)
def test_error_in_the_answer_of_a_slave(protocol: str, data: str, is_error: bool) -> None:
    text = error_in_result(MailboxData(data), opened(protocol))
    assert bool(text) == is_error
    assert protocol != "coe" or not is_error or "read-only entry (0x06010002)" in text
