"""AoE in frames of type 5 on Ethernet: two stations behind one MAC address, asked over a cable."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from eap.codec.ethercat import ETHERTYPE
from eap.ids import EAP_MULTICAST_MAC, MacAddr
from tests.support import aoe
from tests.support.appliance import Plants
from tests.support.namespaces import Namespace, cable

pytestmark = [pytest.mark.net, pytest.mark.root]

PLANT = """\
plant: ether
defaults: {cycle_us: 10000}
stations:
  - name: left
    net_id: 5.1.1.1.1.1
    ports: [{name: eap0, kind: eap, interface: "ethernet://line0", net_id: 5.1.1.1.2.1}]
  - name: right
    net_id: 5.1.1.2.1.1
    ports: [{name: eap0, kind: eap, interface: "ethernet://line0", net_id: 5.1.1.2.2.1}]
"""
LEFT, RIGHT, NOBODY = "5.1.1.1.2.1", "5.1.1.2.2.1", "9.9.9.9.9.9"


class Tool:
    """The other end of the cable: whole Ethernet frames of EtherType 0x88A4."""

    def __init__(self, own: Namespace, station: MacAddr) -> None:
        self.socket = own.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERTYPE))
        self.socket.bind(("line0", ETHERTYPE))
        self.socket.settimeout(5)
        self.address = bytes(MacAddr.parse(own.mac()))
        self.station = bytes(station)

    def ask(self, target: str, body: bytes, *, to: bytes = b"") -> None:
        octets = aoe.frame(aoe.packet(target, aoe.READ, body))
        header = (to or self.station) + self.address + ETHERTYPE.to_bytes(2, "big")
        self.socket.send((header + octets).ljust(60, b"\0"))

    def hear(self) -> aoe.Answer:
        data = self.socket.recv(2048)
        assert data[:6] == self.address
        assert data[6:12] == self.station
        assert data[12:14] == b"\x88\xa4"
        assert len(data) >= 60
        return aoe.answer(data[14:])

    def hears_nothing(self) -> bool:
        self.socket.settimeout(0.3)
        try:
            self.socket.recv(2048)
        except TimeoutError:
            return True
        finally:
            self.socket.settimeout(5)
        return False


@pytest.fixture(scope="module")
def tool(module_farm: Plants) -> Iterator[Tool]:
    with cable() as (here, there):
        module_farm.run(module_farm.write(PLANT), prefix=here.prefix)
        tool = Tool(there, MacAddr.parse(here.mac()))
        with tool.socket:
            yield tool


def net_id_of(answer: aoe.Answer) -> bytes:
    assert (answer.error, answer.result) == (0, 0)
    return answer.data


def test_each_station_answers_for_itself(tool: Tool) -> None:
    question = aoe.read_body(0xF920 << 16 | 1)
    for target in (LEFT, RIGHT):
        for to in (tool.station, bytes(EAP_MULTICAST_MAC), b"\xff" * 6):
            tool.ask(target, question, to=to)
            assert net_id_of(tool.hear()) == aoe.net_id(target)
    assert tool.hears_nothing()


def test_stranger_gets_one_error_and_only_for_a_request(tool: Tool) -> None:
    question = aoe.read_body(0xF920 << 16 | 1)
    tool.ask(NOBODY, question)
    assert tool.hear().error == 7
    tool.ask(NOBODY, question, to=bytes(EAP_MULTICAST_MAC))
    assert tool.hears_nothing()


def test_whole_object_is_read(tool: Tool) -> None:
    tool.ask(LEFT, aoe.read_body(0xF810 << 16 | 0x100))
    whole = tool.hear()
    assert (whole.error, whole.result) == (0, 0)
    assert b"ethernet://line0" in whole.data
