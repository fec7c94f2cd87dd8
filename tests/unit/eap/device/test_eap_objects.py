from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from msgspec.structs import replace

from eap.codec import datatypes
from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_objects import DeviceIdentity, NothingRuns
from eap.device.pdlayout import bus_variables
from eap.od import model
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.model import Access, ObjectCode, OdState
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000 import MORE_TX_PDO, EapLive, FrameSub, Tx, Var
from eap.pd.spec import PortKind, PortSpec, VariableSpec
from tests.support.downloads import PREOP, frame, mapping, receiver, sender, tx_pd, variable, write
from tests.support.stations import BLANK


@pytest.mark.parametrize("row", profile.ALL, ids=lambda row: f"{row.first:04X}")
def test_an_object_has_what_its_row_says(udp, row):
    item = udp.make_object(row, row.last)
    assert item.name == row.title(row.last)
    assert item.code is row.code
    for each in row.entries:
        if not each.last:
            entry = item.entries[each.subindex]
            assert entry.name == each.name
            assert entry.access == each.access
            if each.kind:
                assert entry.kind == datatypes.parse(each.kind)
    if row.code is ObjectCode.VAR:
        assert list(item.entries) == [0]
    else:
        assert item.max_subindex == row.fixed_count
        is_writable = bool(item.entries[0].access & Access.WRITE_PREOP)
        assert is_writable == (row.dynamic or row.list_row is not None)


def test_units_and_limits_are_those_of_the_row(udp):
    entry = udp[0xF800].entries[8]
    assert (entry.unit, entry.minimum, entry.maximum) == (0xFA030000, 100, 60_000_000)


def test_objects_outside_the_profile_are_not_added(udp):
    with pytest.raises(SdoAbortError) as caught:
        udp.add(model.variable(0x5000, "stranger", "UINT"))
    assert caught.value.code == AbortCode.NO_OBJECT


def test_members_are_listed_in_order_of_their_indexes(udp):
    for index in (0x6005, 0x6001, 0x7000):
        udp.make(profile.row_of(index), index)
    assert udp.members(*profile.VARIABLES) == [0x6001, 0x6005, 0x7000]
    udp.remove(0x6005)
    udp.remove(0x6005)
    assert udp.members(profile.TX_VARIABLE) == [0x6001]


def test_a_longest_list_has_names_for_all_entries(udp):
    item = udp.make_object(profile.TX_FRAME, 0x8000, last=254)
    assert item.entries[FrameSub.TXPD].name == "TxPD 0"
    assert item.entries[254].name == "TxPD 238"
    assert item.max_subindex == 254


def test_growing_what_has_no_list_changes_nothing(udp):
    item = udp.make(profile.TX_PD, 0xD000)
    udp.grow(0xD000, 30)
    assert item.max_subindex == max(item.entries) == profile.TX_PD.fixed_count


def test_a_type_makes_value_and_default_as_large(udp):
    item = udp.make(profile.RX_VARIABLE, 0x7000)
    udp.put(0x7000, Var.TYPE_NAME, b"BLOCK(9)")
    assert item.entries[Var.VALUE].kind.size == item.entries[Var.DEFAULT].kind.size == 9
    both = Access.RX_MAPPABLE | Access.TX_MAPPABLE
    assert item.entries[Var.VALUE].access & both == both


def test_rights_follow_the_entry_that_grants_them(udp):
    item = udp.make(profile.TX_FRAME, 0x8000)
    udp.put(0x8000, FrameSub.CHANGEABLE, b"\1")
    assert item.entries[FrameSub.DESTINATION_IP].access & Access.WRITE_OP
    assert not item.entries[FrameSub.DIVIDER].access & Access.WRITE_OP
    udp.put(0x8000, FrameSub.CHANGEABLE, b"\0")
    assert not item.entries[FrameSub.DESTINATION_IP].access & Access.WRITE_OP


def _read(dictionary: EapDictionary, index: int, subindex: int) -> int:
    return int.from_bytes(dictionary.upload(index, subindex, OdState.OP), "little")


def test_identity_and_port_are_shown(udp, ethernet):
    assert _read(udp, 0x1000, 0) == 0x03E81389
    assert udp.upload(0xF920, 1, PREOP) == bytes((127, 0, 9, 1, 2, 1))
    assert udp.upload(0xF810, 3, PREOP) == b"udp://127.0.9.1"
    assert [_read(each, 0xF810, 2) for each in (udp, ethernet)] == [0, 1]
    assert _read(udp, 0xF000, 1) == 1


def test_identity_can_be_another():
    identity = DeviceIdentity(device_name="oven", vendor=2, serial=77)
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
    assert _read(udp, 0x8000, FrameSub.FRAME_LENGTH) == 14 + 8 + 2
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
    assert udp.user_of(0xD000) == (0x8000, FrameSub.TXPD)
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


def test_nothing_is_shown_of_what_does_not_run():
    assert {NothingRuns().octets(key, "any") for key in EapLive} == {None}
