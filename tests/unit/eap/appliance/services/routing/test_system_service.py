"""What a router says of itself."""

from __future__ import annotations

import pytest

from eap.aoe.way import Way
from eap.appliance.services.routing.service import LocalRequest
from eap.appliance.services.routing.system_service import SystemService
from eap.codec.ams import decode_packet
from tests.support import aoe

WAY = Way("door", "1")


def answer(command: int, body: bytes = b""):
    header, data = decode_packet(aoe.packet("1.1.1.1.1.1", command, body, port=10_000))
    service = SystemService("island")
    assert header.target_port in service.ports
    service.client_gone(WAY)
    return service.answer(LocalRequest(header, bytes(data), WAY))


def test_it_runs_and_has_a_name():
    assert answer(aoe.READ_STATE).data == bytes.fromhex("00000000 0500 0000")
    assert answer(1).data[8:].rstrip(b"\0") == b"island"


@pytest.mark.parametrize("command", [aoe.READ, aoe.WRITE, 5, 6, 7, 9, 77])
def test_it_does_nothing_else(command):
    assert answer(command, bytes(60)).error_code == 0x701
