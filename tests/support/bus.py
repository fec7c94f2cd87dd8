"""A master of one datagram at a time, for tests of simulated slaves."""

from __future__ import annotations

from typing import NamedTuple

from devicebus.sim.devices.build import build_slave
from devicebus.sim.segment import SimulatedSegment
from devicebus.sim.spec import ChannelSpec, DeviceKind, FileSpec, MailboxSpec, SlaveSpec
from devicebus.wire import sii
from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import Command, Datagram, DatagramHeader, encode_frame, iter_datagrams
from devicebus.wire.register import Fmmu, Register, SyncManager

STATION = 0x3E9


class Answer(NamedTuple):
    """Reply to a request."""

    data: bytes
    wkc: int
    adp: int
    header: DatagramHeader


def datagram(command: Command, adp: int, ado: int, data: bytes, **more: int) -> Datagram:
    return Datagram(DatagramHeader(command, 0, adp, ado, len(data), **more), data)


def send(chain, command: Command, adp: int, ado: int, data: bytes, now_ns: int = 0) -> Answer:
    """Send one datagram through *chain* (a Segment or a Chain)."""
    frame = bytearray(encode_frame([datagram(command, adp, ado, data)]))
    if isinstance(chain, SimulatedSegment):
        assert chain.process_frame(frame, now_ns) is not None, "the frame is lost"
    else:
        assert chain.process(frame, now_ns)
    ((header, found, wkc),) = iter_datagrams(frame)
    return Answer(bytes(found), wkc, header.adp, header)


def generic(name: str = "slave", **more) -> SlaveSpec:
    """A slave with some of everything."""
    given = {
        "kind": DeviceKind.GENERIC,
        "mailbox": MailboxSpec(foe=True),
        "files": (FileSpec(name="firmware.bin"),),
        "inputs": (ChannelSpec(name="level", type="UINT"), ChannelSpec(name="limit")),
        "outputs": (ChannelSpec(name="speed", type="UINT"), ChannelSpec(name="valve")),
    }
    return SlaveSpec(name=name, **(given | more))


class Bench:
    """A segment with slaves at stations from 0x3E9 on, and what a master does with them."""

    def __init__(self, *specs: SlaveSpec, **more) -> None:
        self.segment = SimulatedSegment(
            [build_slave(spec) for spec in specs or (generic(),)], **more
        )
        self.slaves = self.segment.slaves
        self.now_ns = 0
        for position in range(len(self.slaves)):
            address = (STATION + position).to_bytes(2, "little")
            self.send(Command.APWR, -position & 0xFFFF, Register.STATION_ADDRESS, address)

    def send(self, command: Command, adp: int, ado: int, data: bytes) -> Answer:
        return send(self.segment, command, adp, ado, data, self.now_ns)

    def read(self, ado: int, size: int, station: int = STATION) -> Answer:
        return self.send(Command.FPRD, station, ado, bytes(size))

    def write(self, ado: int, data: bytes, station: int = STATION) -> int:
        return self.send(Command.FPWR, station, ado, data).wkc

    def ask(self, state: int, station: int = STATION) -> None:
        """Write AL control."""
        assert self.write(Register.AL_CONTROL, state.to_bytes(2, "little"), station) == 1

    def status(self, station: int = STATION) -> tuple[int, int]:
        """AL status with its error bit, and the code."""
        octets = self.read(Register.AL_STATUS, 6, station).data
        return octets[0], int.from_bytes(octets[4:6], "little")

    def image(self, number: int = 0) -> sii.Sii:
        return sii.decode(self.slaves[number].esc.image)

    def set_channels(self, number: int = 0, first: int = 0, last: int = 4) -> None:
        """Set up the sync managers as the EEPROM asks for."""
        for at, each in enumerate(self.image(number).sync_managers[first:last], first):
            self.write(
                Register.SYNC_MANAGER + 8 * at,
                SyncManager.decode(each.encode()[:5] + bytes((0, each.enable, 0))).encode(),
                STATION + number,
            )

    def set_fmmus(self, number: int = 0, address: int = 0x10000) -> int:
        """Map outputs, then inputs; return the octets mapped."""
        slave = self.slaves[number]
        start = address
        for unit, channel in enumerate(slave.device.process_data.channels):
            size, kind = channel.size, 2 if channel.is_output else 1
            physical = self.image(number).sync_managers[channel.number].start
            fmmu = Fmmu(address, size, physical_start=physical, type=kind, activate=1)
            if size:
                self.write(Register.FMMU + 16 * unit, fmmu.encode(), STATION + number)
            address += size
        return address - start

    def bring(self, state: AlState, number: int = 0) -> None:
        """Lead a slave up to *state*, without outputs."""
        station = STATION + number
        self.set_channels(number, 0, 2 if self.slaves[number].device.mailbox else 0)
        ladder = (AlState.PREOP, AlState.SAFEOP, AlState.OP)
        for step in (AlState.BOOT,) if state is AlState.BOOT else ladder[: ladder.index(state) + 1]:
            if step is AlState.SAFEOP:
                self.set_channels(number, 2 if self.slaves[number].device.mailbox else 0)
                self.set_fmmus(number)
            if step is AlState.OP:
                self.cycle(number)
            self.ask(step, station)
            assert self.status(station) == (step, 0)

    def cycle(
        self, number: int = 0, outputs: bytes | None = None, address: int = 0x10000
    ) -> Answer:
        """Exchange process data by LRW."""
        process_data = self.slaves[number].device.process_data
        size = process_data.outputs.size
        data = (outputs or bytes(size)) + bytes(process_data.inputs.size)
        return self.send(Command.LRW, address & 0xFFFF, address >> 16, data)

    def post(self, message: bytes, station: int = STATION) -> int:
        """Write a mailbox message; return the working counter."""
        number = station - STATION
        box = self.image(number).sync_managers[0]
        return self.write(box.start, message.ljust(box.length, b"\0"), station)

    def fetch(self, station: int = STATION) -> Answer:
        """Read the mailbox."""
        box = self.image(station - STATION).sync_managers[1]
        return self.read(box.start, box.length, station)
