"""Frames of an engine's ports in the ring, while a reader wants them."""

from __future__ import annotations

import select
import socket
from time import monotonic_ns

import msgspec
import pytest

from eap.codec.pd import decode_frame_header
from eap.engine.build import EnginePlant
from eap.net.framering_file import AttachedRing
from eap.pd.address import source_text
from eap.pd.framering import RECORDING_TERM_NS, records_in
from eap.pd.spec import TxFrameSpec, TxPdSpec, record_to_lines
from eap.runtime.engine_messages import Configure
from eap.runtime.folder import ApplianceFolder
from eap.runtime.handover import NO_DESCRIPTOR, Handover
from eap.supervisor.sockets import SharedSockets
from tests.unit.eap.conftest import eap_port, left, right

pytestmark = pytest.mark.net


class Recorded:
    """An engine's plant on a real clock's time, and a reader of its frames."""

    def __init__(self, folder, specs, sockets=()) -> None:
        self.folder = ApplianceFolder(folder)
        self.plant = self.start(specs, sockets)
        self.ring = AttachedRing(self.folder.frames, 1 << 20)
        self.want()

    def start(self, specs, sockets=()):
        handover = Handover(
            1, str(self.folder.path), "demo", "demo.yaml", tuple(specs), tuple(sockets)
        )
        self.plant = EnginePlant(handover)
        self.plant.start(monotonic_ns())
        return self.plant

    def want(self):
        now_ns = monotonic_ns()
        self.ring.reader.header.extend(now_ns)
        self.plant.recording.look(now_ns)

    def cycles(self, count=1):
        for _ in range(2 * count):
            self.plant.engine.handle_timeout(self.plant.engine.next_timeout())

    def records(self):
        ports = self.ring.reader.header.ports
        return [
            (ports[each.port], each)
            for run in self.ring.reader.runs()
            for each in records_in(run.octets)
        ]

    def close(self):
        self.ring.close()
        self.plant.close()


@pytest.fixture
def open_recorded(tmp_path):
    opened = []

    def make(specs, sockets=()):
        opened.append(Recorded(tmp_path, specs, sockets))
        return opened[-1]

    yield make
    for each in opened:
        each.close()


LINE = [left(eap_port(1, "loop://line")), right(eap_port(2, "loop://line"))]


def counters(records, port, *, is_sent):
    return [
        decode_frame_header(each.frame).cycle
        for name, each in records
        if name == port and each.is_sent is is_sent
    ]


def test_frames_of_a_line_in_memory_are_recorded_on_both_sides(open_recorded):
    recorded = open_recorded(LINE)
    recorded.cycles(5)
    records = recorded.records()
    sent = counters(records, "left/eap0", is_sent=True)
    received = counters(records, "right/eap0", is_sent=False)
    assert len(sent) == 5
    assert received == sent[: len(received)]
    assert len(received) >= 4
    times = {decode_frame_header(each.frame).cycle: set() for _, each in records}
    for _, each in records:
        times[decode_frame_header(each.frame).cycle].add(each.at_ns)
    assert all(len(each) == 1 for each in times.values())  # received when it was sent


def test_recording_ends_with_its_readers_and_leaves_nothing_behind(open_recorded):
    recorded = open_recorded(LINE)
    recorded.cycles(2)
    assert recorded.records()
    recorded.plant.recording.look(monotonic_ns() + 2 * RECORDING_TERM_NS)
    recorded.cycles(3)
    assert recorded.records() == []
    stations = recorded.plant.engine._stations
    assert all("FrameTap" not in repr(each.handlers) for each in stations)
    assert all(
        type(channel).__name__ == "LoopbackChannel"
        for each in stations
        for _, channel, _, _ in each._outlets
    )
    recorded.want()
    recorded.cycles(3)
    assert recorded.records()


def test_recording_goes_on_when_a_station_is_changed(open_recorded):
    recorded = open_recorded(LINE)
    recorded.cycles(3)
    recorded.records()
    (frame,) = LINE[0].frames
    more = TxFrameSpec("more", "eap0", "127.9.2.2", (TxPdSpec("extra", 8, ("running",)),))
    changed = msgspec.structs.replace(LINE[0], frames=(frame, more))
    path = recorded.folder.path / "1.spec"
    path.write_bytes(record_to_lines(changed))
    answers = []
    rebuilder = recorded.plant.rebuilder
    rebuilder.serve(Configure(id=1, station="left", path=str(path)), monotonic_ns(), answers.append)
    while not answers:
        if select.select([rebuilder], [], [], 0.01)[0]:
            rebuilder.collect(recorded.plant.engine.next_timeout() - 1)
        if rebuilder.is_ready:
            rebuilder.swap(recorded.plant.engine.next_timeout() - 1)
    assert answers == [None]
    recorded.records()
    recorded.cycles(2)  # no look between the change and these
    sent = counters(recorded.records(), "left/eap0", is_sent=True)
    assert len(sent) == 4  # two frames in each cycle
    recorded.plant.recording.look(monotonic_ns() + 2 * RECORDING_TERM_NS)
    recorded.cycles(2)
    assert recorded.records() == []


def test_restarted_engine_goes_on_in_the_same_ring(open_recorded):
    recorded = open_recorded(LINE)
    recorded.cycles(2)
    recorded.records()
    recorded.plant.close()
    recorded.start(LINE)
    recorded.want()
    recorded.cycles(2)
    runs = list(recorded.ring.reader.runs())
    assert [run.lost for run in runs] == [0] * len(runs)
    assert sum(len(list(records_in(run.octets))) for run in runs) >= 3


def test_datagrams_are_recorded_with_their_addresses(open_recorded, tmp_path):
    stations = [left(), right(eap_port(2, tcp=True))]
    sockets = SharedSockets(tmp_path / "control")
    try:
        given = [
            msgspec.structs.replace(each, engine_fd=socket.dup(each.engine_fd))
            for each in sockets.fit(stations)
            if each.engine_fd != NO_DESCRIPTOR
        ]
        recorded = open_recorded(stations, given)
        recorded.cycles(4)
        records = recorded.records()
    finally:
        sockets.close()
    sent = [each for name, each in records if name == "left/eap0"]
    received = [each for name, each in records if name == "right/eap0"]
    assert {each.is_sent for each in sent} == {True}
    assert {each.is_sent for each in received} == {False}
    assert {source_text(each.address) for each in sent} == {"127.9.2.2"}
    assert {source_text(each.address) for each in received} == {"127.9.2.1"}
    assert [each.frame for each in received] == [each.frame for each in sent][: len(received)]
    # The kernel's stamp is never before that of the sending.
    assert all(r.at_ns >= s.at_ns for s, r in zip(sent, received, strict=False))
