"""Mailboxes that somebody used before."""

from __future__ import annotations

import pytest

from devicebus.errors import BusError
from devicebus.mailbox import coe_client, foe_client, soe_client, voe
from devicebus.mailbox.coe_server import SdoServer
from devicebus.wire.alstatus import AlState
from eap.codec.coe import SdoRequest
from eap.codec.soe import Idn
from tests.support.loopbus import LoopBus

BUS = """
bus: protocols
slaves:
  - {name: coe, kind: coupler}
  - {name: foe, kind: generic, mailbox: {coe: false, foe: true}, files: [{name: a, content: xyz}]}
  - {name: soe, kind: drive, mailbox: {coe: false, soe: true}}
  - {name: voe, kind: generic, mailbox: {coe: false, voe: true}}
  - {name: none, kind: coupler, mailbox: null}
"""


def read_file(sizes):
    return foe_client.read("a", bytearray().extend, sizes)


REQUESTS = {
    "coe": lambda sizes: coe_client.upload(0x1018, 1),
    "foe": read_file,
    "soe": lambda sizes: soe_client.read(Idn.parse("S-0-0032")),
    "voe": lambda sizes: voe.exchange(1, 2, b"x"),
}


@pytest.fixture
def line(tmp_path):
    (tmp_path / "bus.yaml").write_text(BUS)
    return LoopBus("bus", tmp_path)


@pytest.mark.parametrize("name", REQUESTS)
def test_every_session_is_answered(line, name):
    """The counter of the last message of the session before does not matter.

    A request of this test has the same answer each time, so that a lost or a stale one is seen.
    """
    answers = []
    for number in range(9):
        with line.session() as bus:
            unit = bus.find(name)
            requests = range(1 + number % 2)
            answers += [bus.converse(unit, REQUESTS[name], "request") for _ in requests]
    assert len(set(answers)) == 1


def test_slave_that_an_abort_makes_deaf(line, monkeypatch):
    """SOES begins a transfer with any SDO request, and never ends one that is an abort."""
    plain = SdoServer.receive_request
    aborted = []

    def receive_request(server, body):
        if body[0] >> 5 == SdoRequest.ABORT:
            aborted.append(body)
        return [] if aborted else plain(server, body)

    monkeypatch.setattr(SdoServer, "receive_request", receive_request)
    for _ in range(2):
        with line.session() as bus:
            unit = bus.find("coe")
            assert bus.converse(unit, REQUESTS["coe"], "request") == (0xE5A).to_bytes(4, "little")


def test_attach_in_boot_uses_the_boot_mailbox(line):
    for _ in range(2):
        with line.session() as bus:
            unit = bus.find("foe")
            if unit.status.state != AlState.BOOT:
                bus.bring([unit], AlState.BOOT)
            assert bus.converse(unit, read_file, "file") == 3


def test_slave_without_a_mailbox(line):
    for state in ("INIT", "PREOP"):
        with line.session() as bus:
            unit = bus.find("none")
            assert AlState(unit.status.state).name == state
            with pytest.raises(BusError, match="no mailbox in PREOP"):
                bus.converse(unit, REQUESTS["coe"], "request")
