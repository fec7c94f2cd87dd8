"""Endpoints and answers."""

from __future__ import annotations

from eap.ads.endpoint import AmsAnswer, Endpoint, response_to
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags, decode_packet
from eap.ids import NetId


def test_endpoint_text_has_connection_and_transport() -> None:
    assert str(Endpoint("AMS/TCP", "10.0.0.1:3456 #7")) == "10.0.0.1:3456 #7 by AMS/TCP"
    assert str(Endpoint("ams-tcp:10.0.0.1:48898", "10.0.0.1:48898")) == "10.0.0.1:48898 by ams-tcp"


ASKED = AmsHeader(NetId(b"target"), 1001, NetId(b"source"), 33000, AmsCommand.READ, invoke_id=7)


def test_response_keeps_command_and_invoke_id() -> None:
    header, body = decode_packet(response_to(ASKED, AmsAnswer(b"data", 6)))
    assert (header.target, header.target_port) == (ASKED.source, ASKED.source_port)
    assert (header.source, header.source_port) == (ASKED.target, ASKED.target_port)
    assert header.state_flags == StateFlags.ADS | StateFlags.RESPONSE
    assert (header.command, header.invoke_id, header.error_code) == (AmsCommand.READ, 7, 6)
    assert bytes(body) == b"data"
