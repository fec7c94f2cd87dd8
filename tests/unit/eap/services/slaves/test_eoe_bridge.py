"""EoE of a bus: host, switch and simulated slaves, with a pair of sockets in place of the TAP."""

from __future__ import annotations

import asyncio
import socket
import tempfile
from collections.abc import Awaitable, Callable, Iterator
from ipaddress import IPv4Interface
from pathlib import Path

import pytest
from scapy.layers.inet import ICMP, IP
from scapy.layers.l2 import ARP, Ether

from devicebus.mailbox import coe_client
from devicebus.master.mailboxes import Unsolicited
from devicebus.sim.spec import FaultKind, FaultSpec
from devicebus.wire.alstatus import AlState
from eap.codec.eoe import EoeResult
from eap.codec.mailbox import MailboxType
from eap.errors import EnvironmentalError
from eap.ids import MacAddr
from eap.pd.spec import EoeSlaveSpec, EoeSpec
from eap.runtime.bus_status import find_eoe_faults
from eap.services.engine_link import EngineLink
from eap.services.slaves import eoe_bridge
from eap.services.slaves.bus_client import BusClient
from eap.services.slaves.eoe_bridge import EoeBridge, default_mac
from tests.support.busads import until
from tests.support.fakeengine import PORT, FakeBus, FakeEngine
from tests.support.loopbus import LoopBus
from tests.support.virtualtime import run_virtual

BUS = """
bus: drives
slaves:
  - {name: left, kind: generic, mailbox: {size: 128, eoe: true}}
  - {name: right, kind: generic, mailbox: {size: 256, eoe: true}}
  - {name: deaf, kind: generic, mailbox: {size: 128}}
"""
HOST_MAC, HOST_IP = "02:00:00:00:00:01", "10.0.0.1"
LEFT, RIGHT = (str(default_mac(station)) for station in (1001, 1002))
SPEC = EoeSpec(
    "eoe0",
    "10.0.0.1/24",
    (
        EoeSlaveSpec("left", "10.0.0.10/24", gateway="10.0.0.11", dns="10.0.0.1", name="axis"),
        EoeSlaveSpec("1002", "10.0.0.11/24"),
    ),
)


class PairedTap:
    """A TAP whose other end is :attr:`host`."""

    def __init__(self, name: str, address: IPv4Interface | None) -> None:
        self.name, self.address, self.dropped, self.up = name, address, 0, True
        self._sock, self.host = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for each in (self._sock, self.host):
            each.setblocking(False)

    def fileno(self) -> int:
        return self._sock.fileno()

    def close(self) -> None:
        self._sock.close()
        self.host.close()

    def is_up(self) -> bool:
        return self.up

    def read_frames(self) -> Iterator[bytes]:
        while True:
            try:
                frame = self._sock.recv(2048)
            except BlockingIOError:
                return
            if not frame:
                raise OSError(77, "File descriptor in bad state")
            yield frame

    def write_frame(self, frame: bytes) -> None:
        self._sock.send(frame)


class Scene:
    """A bridge between simulated slaves and a host."""

    def __init__(
        self, spec: EoeSpec, error: str, prepare: Callable[[LoopBus], None] | None
    ) -> None:
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "drives.yaml").write_text(BUS)
            self.line = LoopBus("drives", Path(folder))
        if prepare is not None:
            prepare(self.line)
        self.engine = FakeEngine(FakeBus(self.line))
        self.link = EngineLink(self.engine.services, silence_limit_s=1.0)
        self.bus = BusClient(self.link, 0, PORT)
        self.taps: list[PairedTap] = []
        self.error = error
        self.bridge = EoeBridge(self.bus, spec, self._open)

    def _open(self, name: str, address: IPv4Interface | None) -> PairedTap:
        if self.error:
            raise EnvironmentalError(self.error)
        self.taps.append(PairedTap(name, address))
        return self.taps[-1]

    def send(self, packet: object, target: str) -> None:
        """Send a packet of the host."""
        self.taps[-1].host.send(bytes(Ether(src=HOST_MAC, dst=target) / packet))

    async def receive(self, layer: type) -> Ether:
        """Return the next frame for the host that has a layer."""
        loop = asyncio.get_running_loop()
        while True:
            frame = Ether(await loop.sock_recv(self.taps[-1].host, 2048))
            if layer in frame:
                return frame

    async def ports_are(self, condition: Callable[[dict[str, object]], bool]) -> None:
        async def look() -> bool:
            return condition({each.name: each for each in self.bridge.report().slaves})

        await until(look)


def play(
    scene: Callable[[Scene], Awaitable[None]],
    spec: EoeSpec = SPEC,
    *,
    error: str = "",
    prepare: Callable[[LoopBus], None] | None = None,
) -> None:
    async def run() -> None:
        stage = Scene(spec, error, prepare)
        serving = asyncio.ensure_future(stage.bridge.serve())
        try:
            async with asyncio.timeout(20):
                await stage.bus.view.current()
                await scene(stage)
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
            stage.link.close()
            stage.engine.close()
            for tap in stage.taps:
                tap.close()

    run_virtual(run())


def test_host_reaches_slaves_with_the_settings_of_the_plant():
    async def scene(stage):
        await stage.ports_are(
            lambda ports: {each.ip for each in ports.values()} == {"10.0.0.10", "10.0.0.11"}
        )
        assert stage.taps[0].address == IPv4Interface("10.0.0.1/24")
        stage.send(ARP(hwsrc=HOST_MAC, psrc=HOST_IP, pdst="10.0.0.10"), "ff:ff:ff:ff:ff:ff")
        while (answer := await stage.receive(ARP))[ARP].op != 2:
            pass
        assert (answer.src, answer[ARP].psrc) == (LEFT, "10.0.0.10")
        for target, mac in (("10.0.0.10", LEFT), ("10.0.0.11", RIGHT)):
            stage.send(IP(src=HOST_IP, dst=target) / ICMP() / bytes(1000), mac)
            pong = await stage.receive(ICMP)
            assert (pong[IP].src, pong[ICMP].type, len(pong[ICMP].payload)) == (target, 0, 1000)
        report = stage.bridge.report()
        assert (report.interface, report.fault) == ("eoe0", "")
        assert list(find_eoe_faults(report)) == []
        assert {each.name: each.addresses for each in report.slaves} == {
            "left": (LEFT,),
            "right": (RIGHT,),
        }
        assert not any(each.invalid or each.failed or each.dropped for each in report.slaves)

    play(scene)


def test_slaves_reach_each_other_without_a_tap():
    async def scene(stage):
        # "left" looks for its gateway, which is "right": a broadcast, and an answer to one slave.
        await stage.ports_are(lambda ports: len(ports) == 2 and ports["left"].sent >= 2)
        report = stage.bridge.report()
        assert (report.fault, report.sent) == ("no TAP here", 0)
        (finding,) = find_eoe_faults(report)
        assert finding.what == "EoE: no TAP here"

    play(scene, error="no TAP here")


def test_all_slaves_with_eoe_are_connected_without_a_list():
    async def scene(stage):
        await stage.ports_are(lambda ports: {*ports} == {"left", "right"})
        assert [each.ip for each in stage.bridge.report().slaves] == ["", ""]

    play(scene, EoeSpec("eoe0", connects_all=True))


def test_slave_is_disconnected_in_init_and_gets_its_settings_again():
    async def scene(stage):
        await stage.ports_are(lambda ports: len(ports) == 2 and ports["left"].ip == "10.0.0.10")
        await stage.bus.bring(1001, AlState.INIT)
        await stage.ports_are(lambda ports: not ports["left"].is_connected)
        assert stage.bridge.report().slaves[0].addresses == ()
        await stage.bus.bring(1001, AlState.PREOP)
        await stage.ports_are(lambda ports: ports["left"].ip == "10.0.0.10")

    play(scene)


def test_slave_without_eoe_in_the_plant_file_is_a_finding():
    async def scene(stage):
        await stage.ports_are(lambda ports: "deaf" in ports and not ports["deaf"].is_connected)
        (finding,) = find_eoe_faults(stage.bridge.report())
        assert finding.what.startswith("slave 1003 (deaf): EoE: the slave does not support EoE")

    play(scene, EoeSpec("eoe0", slaves=(EoeSlaveSpec("deaf"),)))


def test_settings_that_a_slave_refuses_are_a_finding(caplog):
    async def scene(stage):
        await stage.ports_are(lambda ports: len(ports) == 2 and ports["left"].fault)
        (finding,) = find_eoe_faults(stage.bridge.report())
        assert finding.slaves == (1001,)
        refusal = "EoE: IP settings: EoE set IP: IP is not supported (0x0201)"
        assert finding.what == f"slave 1001 (left): {refusal}"
        await stage.ports_are(lambda ports: ports["right"].ip)
        assert f"left/bus0/left: {refusal.removeprefix('EoE: ')}" in caplog.text

    def refuse(line: LoopBus) -> None:
        server = line.segment.segment.slaves[0].device.mailbox.protocols[MailboxType.EOE]
        server._accept = lambda settings: EoeResult.NO_IP

    play(scene, prepare=refuse)


def test_settings_are_written_again_to_a_slave_that_did_not_answer(monkeypatch):
    monkeypatch.setattr(eoe_bridge, "SETTINGS_PAUSE_S", 0.05)

    async def scene(stage):
        deaf = FaultSpec(kind=FaultKind.MAILBOX, slave="left")
        stage.line.segment.begin(deaf, stage.line.now_ns)
        await stage.bus.bring(1001, AlState.INIT)
        await stage.bus.bring(1001, AlState.PREOP)
        await stage.ports_are(lambda ports: "no EOE reply" in ports["left"].fault)
        stage.line.segment.end(deaf, stage.line.now_ns)
        await stage.ports_are(lambda ports: ports["left"].ip == "10.0.0.10")

    play(scene)


def test_interface_that_is_gone_is_opened_again(monkeypatch):
    monkeypatch.setattr(eoe_bridge, "OPEN_RETRY_S", 0.05)

    async def scene(stage):
        await stage.ports_are(lambda ports: len(ports) == 2)
        stage.taps[0].up = False
        assert stage.bridge.report().fault.startswith("TAP interface eoe0 is down: ")
        stage.taps[0].host.close()

        async def is_open_again() -> bool:
            return len(stage.taps) == 2 and not stage.bridge.report().fault

        await until(is_open_again)
        stage.send(IP(src=HOST_IP, dst="10.0.0.11") / ICMP(), RIGHT)
        assert (await stage.receive(ICMP))[IP].src == "10.0.0.11"

    play(scene)


def test_broken_fragments_are_counted_and_harmless():
    async def scene(stage):
        await stage.ports_are(lambda ports: len(ports) == 2)
        receive = stage.bridge._receive
        for data in ("", "00", "00000000", "0000020041", "0f000000"):
            receive(Unsolicited(1001, MailboxType.EOE, bytes.fromhex(data)))
        receive(Unsolicited(1001, MailboxType.COE, b"\0\x10"))
        receive(Unsolicited(1777, MailboxType.EOE, bytes(64)))
        assert stage.bridge.report().slaves[0].invalid == 4

    play(scene)


def test_sdos_go_on_beside_a_flood_of_frames():
    async def scene(stage):
        await stage.ports_are(lambda ports: len(ports) == 2 and ports["left"].ip)
        for _ in range(40):
            stage.send(IP(src=HOST_IP, dst="10.0.0.10") / ICMP() / bytes(1400), LEFT)
        for _ in range(20):
            data = await stage.bus.converse(1001, coe_client.upload(0x1018, 1), "tool")
            assert data == bytes.fromhex("5a0e0000")
        left = stage.bridge.report().slaves[0]
        assert left.failed == 0

    play(scene)


@pytest.mark.parametrize(("station", "mac"), [(1001, "02:01:05:30:03:e9")])
def test_default_mac_is_that_of_twincat(station, mac):
    assert default_mac(station) == MacAddr.parse(mac)
