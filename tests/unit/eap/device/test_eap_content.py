from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager

from msgspec.structs import replace

from eap.device.eap_content import Identity, bus_variables
from eap.device.eap_dictionary import EapDictionary
from eap.od.model import OdState
from eap.od.profiles.eap1000 import MORE_TX_PDO
from eap.od.profiles.eap1000keys import Frame, Tx, Var
from eap.pd.spec import PortKind, PortSpec, VariableSpec
from tests.support.downloads import PREOP, frame, mapping, receiver, sender, tx_pd, variable, write
from tests.support.stations import BLANK


def _read(dictionary: EapDictionary, index: int, subindex: int) -> int:
    return int.from_bytes(dictionary.upload(index, subindex, OdState.OP), "little")


def test_identity_and_port_are_shown(udp, ethernet):
    assert _read(udp, 0x1000, 0) == 0x03E81389
    assert udp.upload(0xF920, 1, PREOP) == bytes((127, 0, 9, 1, 2, 1))
    assert udp.upload(0xF810, 3, PREOP) == b"udp://127.0.9.1"
    assert [_read(each, 0xF810, 2) for each in (udp, ethernet)] == [0, 1]
    assert _read(udp, 0xF000, 1) == 1


def test_identity_can_be_another():
    identity = Identity(device_name="oven", vendor=2, serial=77)
    station = replace(BLANK, ports=(replace(BLANK.ports[0], profile=5002), *BLANK.ports[1:]))
    dictionary = EapDictionary(station, "eap0", identity=identity)
    assert _read(dictionary, 0x1000, 0) == 1000 << 16 | 5002
    assert dictionary.upload(0x1008, 0, PREOP) == b"oven"
    assert dictionary.upload_complete(0x1018, 1, PREOP) == struct.pack("<4I", 2, 0, 0, 77)


class Recorder:
    """Live values that tell what they were asked for, and within which moment."""

    def __init__(self) -> None:
        self.moments = 0
        self.is_in_moment = False
        self.seen: list[bool] = []

    @contextmanager
    def at_one_moment(self) -> Iterator[None]:
        self.moments += 1
        self.is_in_moment = True
        yield
        self.is_in_moment = False

    def octets(self, key: str, name: str) -> bytes | None:
        self.seen.append(self.is_in_moment)
        return {("value", "level"): b"\x34\x12", ("tx_skipped", "txpd0"): bytes(3)}.get((key, name))


def test_live_entries_show_what_runs_and_zero_when_nothing_does():
    dictionary = sender(EapDictionary(BLANK, "eap0", Recorder()))
    assert _read(dictionary, 0x6000, Var.VALUE) == 0x1234
    assert dictionary.upload(0xB000, 2, OdState.OP) == bytes(8)  # of another size
    assert _read(dictionary, 0xF110, 1) == 0
    variable(dictionary, 0x6001, "other")
    assert _read(dictionary, 0x6001, Var.VALUE) == 0


def test_whole_object_shows_live_entries_of_one_moment():
    live = Recorder()
    dictionary = sender(EapDictionary(BLANK, "eap0", live))
    dictionary.upload_complete(0xB000, 1, OdState.OP)
    assert live.moments == 1
    assert len(live.seen) > 1
    assert all(live.seen)


def test_lengths_counts_and_free_indexes_are_computed(udp):
    assert _read(udp, 0xF801, 2) == 0xD000
    sender(udp)
    receiver(udp)
    write(udp, 0x3000, 1, 0x6000_0110)
    assert _read(udp, 0xD000, Tx.PDO_LENGTH) == 2
    assert _read(udp, 0x8000, Frame.FRAME_LENGTH) == 14 + 8 + 2
    assert [_read(udp, 0xF800, sub) for sub in range(1, 8)] == [1, 1, 1, 2, 1, 1, 1]
    assert [_read(udp, 0xF801, sub) for sub in (1, 2, 4)] == [0x8001, 0xD001, 0x1A01]
    write(udp, 0xD000, Tx.PDO_INDEX, 0x1A07)
    assert _read(udp, 0xD000, Tx.PDO_LENGTH) == 0


def test_bits_are_counted_to_whole_octets(udp):
    variable(udp, 0x6000, "bit", "BOOL")
    variable(udp, 0x6001, "word")
    mapping(udp, 0x1A00, (0x6000, 1), (0, 7), (0x6001, 16), (0x6000, 1))
    tx_pd(udp, 0xD000, 0x1A00, 1)
    assert _read(udp, 0xD000, Tx.PDO_LENGTH) == 4


def test_no_free_index_is_left(udp):
    for number in range(512):
        write(udp, 0x1A00 + number, 0, 0)
    assert _read(udp, 0xF801, 4) == 0x3000
    for index in range(0x3000, 0x3E00):
        udp.make(MORE_TX_PDO, index)
    assert _read(udp, 0xF801, 4) == 0


def test_users_of_an_object_are_found(udp):
    sender(udp)
    frame(udp, 0x8001, 0xD005)
    assert udp.user_of(0x6000) == (0x1A00, 1)
    assert udp.user_of(0xD000) == (0x8000, Frame.TXPD)
    assert udp.user_of(0x8000) is None
    assert udp.user_of(0x1A00) is None


def test_names_are_those_of_what_an_object_is_about(udp):
    sender(udp)
    assert [udp.name_of(i) for i in (0x6000, 0xD000, 0xB000, 0x8000, 0xA000, 0x1A00)] == [
        "level", "txpd0", "txpd0", "frame0", "frame0", "",
    ]  # fmt: skip


def test_variables_of_buses_belong_to_no_dictionary():
    bus = PortSpec("bus0", PortKind.BUS, "sim:///x.yaml", "127.0.9.1.4.1")
    names = ("bus0.state", "bus0.drive.speed", "busy")
    station = replace(
        BLANK,
        ports=(*BLANK.ports, bus),
        variables=tuple(VariableSpec(name, "UINT") for name in names),
    )
    assert bus_variables(station) == {"bus0.state", "bus0.drive.speed"}
