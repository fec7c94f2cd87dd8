"""All fifteen commands and their working counters, and captures of real slaves replayed."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import pytest

from devicebus.sim.esc import Esc, EscSettings
from devicebus.sim.processing import Chain
from devicebus.wire import sii
from devicebus.wire.datagram import Command, encode_frame, iter_datagrams
from devicebus.wire.register import Fmmu
from devicebus.wire.sii import Sii, SiiFixed
from tests.support.bus import datagram, send
from tests.support.vectors import load_datagrams

IMAGE = sii.encode(Sii(fixed=SiiFixed(alias=0x77)))


def line(count=3, **settings) -> tuple[Chain, list[Esc]]:
    escs = [Esc(IMAGE, EscSettings(**settings)) for _ in range(count)]
    for number, esc in enumerate(escs):
        esc.write(0x0010, (1001 + number).to_bytes(2, "little"), 0)
        esc.memory[0x1F00:0x1F02] = bytes((0x10 << number, number))
    return Chain(escs), escs


def u16(number):
    return number.to_bytes(2, "little")


def test_chain_nop_has_no_effect():
    chain, _ = line()
    assert send(chain, Command.NOP, 5, 0x1F00, b"ab")[:3] == (b"ab", 0, 5)


@pytest.mark.parametrize("position", [0, 1, 2])
def test_by_position(position):
    chain, escs = line()
    adp = -position & 0xFFFF
    got = send(chain, Command.APRD, adp, 0x1F00, bytes(2))
    assert got[:3] == (bytes((0x10 << position, position)), 1, (adp + 3) & 0xFFFF)
    assert send(chain, Command.APWR, adp, 0x1F00, b"xy").wkc == 1
    got = send(chain, Command.APRW, adp, 0x1F00, b"zz")
    assert (got.data, got.wkc) == (b"xy", 3)
    assert [esc.peek(0x1F00, 2) == b"zz" for esc in escs].count(True) == 1


def test_chain_position_behind_the_segment_counts_0():
    chain, _ = line()
    assert send(chain, Command.APRD, 0xFFFD, 0x1F00, bytes(2))[:3] == (bytes(2), 0, 0)
    assert send(chain, Command.APRD, 7, 0x1F00, bytes(2))[:3] == (bytes(2), 0, 10)


def test_by_station_address():
    chain, _ = line()
    got = send(chain, Command.FPRD, 1002, 0x1F00, bytes(2))
    assert got[:3] == (b"\x20\x01", 1, 1002)
    assert send(chain, Command.FPWR, 1002, 0x1F00, b"xy").wkc == 1
    assert send(chain, Command.FPRW, 1002, 0x1F00, b"zz")[:2] == (b"xy", 3)
    assert send(chain, Command.FPRD, 1004, 0x1F00, bytes(2)).wkc == 0


def test_new_station_address_counts_at_once():
    chain, _ = line()
    send(chain, Command.FPRD, 1001, 0x1F00, bytes(2))
    assert send(chain, Command.APWR, 0, 0x0010, u16(500)).wkc == 1
    assert send(chain, Command.FPRD, 1001, 0x1F00, bytes(2)).wkc == 0
    assert send(chain, Command.FPRD, 500, 0x1F00, bytes(2)).wkc == 1


def test_esc_alias_is_enabled_by_dl_control():
    chain, _ = line(1)
    assert send(chain, Command.FPRD, 0x77, 0, b"\0").wkc == 0
    send(chain, Command.BWR, 0, 0x0103, b"\1")
    assert send(chain, Command.FPRD, 0x77, 0, b"\0").wkc == 1
    assert send(chain, Command.FPRD, 1001, 0, b"\0").wkc == 1


def test_chain_broadcast_read_is_ored():
    chain, escs = line()
    assert send(chain, Command.BRD, 0, 0x1F00, b"\x01\x00")[:3] == (b"\x71\x03", 3, 3)
    assert send(chain, Command.BWR, 0xFFFF, 0x1F00, b"\x04\x00")[:3] == (b"\x04\x00", 3, 2)
    assert send(chain, Command.BRW, 0, 0x1F00, b"\x08\x00")[:2] == (b"\x0c\x00", 9)
    assert [esc.peek(0x1F00, 1) for esc in escs] == [b"\x08", b"\x0c", b"\x0c"]


@pytest.mark.parametrize(("command", "adp"), [(Command.ARMW, 0xFFFF), (Command.FRMW, 1002)])
def test_chain_read_multiple_write(command, adp):
    chain, escs = line()
    got = send(chain, command, adp, 0x1F00, b"pq")
    assert (got.data, got.wkc) == (b"\x20\x01", 3)
    assert got.adp == (2 if command is Command.ARMW else 1002)
    assert [esc.peek(0x1F00, 2) for esc in escs] == [b"pq", b"\x20\x01", b"\x20\x01"]


def test_chain_unknown_command_is_unchanged():
    chain, _ = line()
    frame = bytearray(encode_frame([datagram(Command.BRD, 0, 0, b"\0")]))
    frame[2] = 15
    before = bytes(frame)
    assert chain.process(frame, 0)
    assert frame == before


def map_octets(chain, station, logical, size, kind, unit=0):
    fmmu = Fmmu(logical, size, physical_start=0x1F00, type=kind, activate=1)
    assert send(chain, Command.FPWR, station, 0x0600 + 16 * unit, fmmu.encode()).wkc == 1


def test_logical_commands_count_a_slave_once_for_each_direction():
    chain, _ = line()
    map_octets(chain, 1001, 0x10000, 1, 1)
    map_octets(chain, 1001, 0x10001, 1, 1, unit=1)
    map_octets(chain, 1002, 0x10002, 1, 2)
    map_octets(chain, 1003, 0x10003, 1, 3)
    for command, wkc in ((Command.LRD, 2), (Command.LWR, 2), (Command.LRW, 1 + 2 + 3)):
        got = send(chain, command, 0, 1, b"abcd")
        assert (got.wkc, got.adp, got.header.ado) == (wkc, 0, 1), command


def test_logical_read_and_write_move_the_right_octets():
    chain, escs = line()
    map_octets(chain, 1001, 0x10000, 2, 1)
    map_octets(chain, 1002, 0x10000, 2, 2)
    got = send(chain, Command.LRW, 0, 1, b"xy")
    assert got.data == b"\x10\x00"
    assert escs[1].peek(0x1F00, 2) == b"\x10\x00"  # what the slave before has put in
    assert send(chain, Command.LWR, 0, 1, b"uv").data == b"uv"
    assert escs[1].peek(0x1F00, 2) == b"uv"
    assert send(chain, Command.LRD, 4, 1, b"uv")[:2] == (b"uv", 0)


def test_chain_new_fmmus_apply_at_once():
    chain, _ = line(2)
    map_octets(chain, 1001, 0x10000, 1, 1)
    assert send(chain, Command.LRD, 0, 1, b"\0")[:2] == (b"\x10", 1)
    map_octets(chain, 1002, 0x10000, 1, 1)
    assert send(chain, Command.LRD, 0, 1, b"\0")[:2] == (b"\x20", 2)
    send(chain, Command.FPWR, 1002, 0x0600, bytes(16))
    assert send(chain, Command.LRD, 0, 1, b"\0")[:2] == (b"\x10", 1)


def test_chain_any_number_of_logical_addresses():
    chain, _ = line(1)
    map_octets(chain, 1001, 0x10000, 0x10, 1)
    counts = [send(chain, Command.LRD, at, 1, b"\0").wkc for at in range(100)]
    assert counts == [1] * 16 + [0] * 84


def test_mailbox_state_can_be_mapped():
    chain, escs = line(1)
    unit = Fmmu(0x10000, 1, 0, 0, 0x080D, 3, 1, 1)
    send(chain, Command.FPWR, 1001, 0x0620, unit.encode())
    assert send(chain, Command.LRD, 0, 1, b"\0")[:2] == (b"\0", 1)
    escs[0].memory[0x080D] = 0x08
    assert send(chain, Command.LRD, 0, 1, b"\0")[:2] == (b"\1", 1)


def test_events_are_joined_into_the_datagram():
    chain, escs = line()
    send(chain, Command.BWR, 0, 0x0200, b"\x0c\x00")
    escs[0].set_al_status(2, 0)
    escs[2].set_dl_status(1)
    assert send(chain, Command.NOP, 0, 0, b"").header.irq == 0x000C


def test_chain_several_datagrams_and_trailing_bytes():
    chain, _ = line()
    frame = bytearray(
        encode_frame(
            [datagram(Command.BRD, 0, 0, b"\0"), datagram(Command.FPRD, 1002, 0x10, b"\0\0")]
        )
    )
    frame += b"padding"
    assert chain.process(frame, 0)
    assert [(bytes(data), wkc) for _, data, wkc in iter_datagrams(frame)] == [
        (b"\x11", 3),
        (u16(1002), 1),
    ]
    assert frame.endswith(b"padding")


@pytest.mark.parametrize("cut", range(2, 25))
def test_broken_frames_are_left_alone(cut):
    chain, _ = line()
    frame = bytearray(encode_frame([datagram(Command.APWR, 0, 0x1F00, bytes(12))]))[:cut]
    before = bytes(frame)
    assert chain.process(frame, 0)
    assert frame == before


@pytest.mark.parametrize("frame", [b"", b"\x10", b"\x10\x40" + bytes(16), b"\x10\x50" + bytes(16)])
def test_other_frames_pass(frame):
    chain, _ = line()
    passed = bytearray(frame)
    assert chain.process(passed, 0)
    assert passed == frame


def test_circulating_frames_are_marked_and_taken_out():
    escs = [Esc(IMAGE)]
    chain = Chain(escs, closed_at=0)
    frame = bytearray(encode_frame([datagram(Command.BRD, 0, 0, b"\0")]))
    assert chain.process(frame, 0)
    assert next(iter_datagrams(frame)).header.circulating == 1
    assert not chain.process(frame, 0)


def settings_of(name: str) -> list[EscSettings]:
    """The slaves of a capture: counts of FMMUs, sync managers and clocks as its answers show."""
    if name.startswith("replay-dc"):
        return [
            EscSettings(type=0x11, fmmus=3, sync_managers=4),
            EscSettings(type=0x12, fmmus=8, sync_managers=8),
            EscSettings(type=0x02, fmmus=3, sync_managers=4, has_dc=False),
        ]
    if name.startswith("soem"):
        return [EscSettings(type=0xC0, revision=2, fmmus=3, sync_managers=4)]
    return [EscSettings(), EscSettings(has_dc=False)]


@cache
def captures() -> dict[str, list[tuple[dict, dict]]]:
    """Datagrams of each capture as sent and as returned; without an answer nobody acted."""
    found: dict[str, list[tuple[dict, dict]]] = {}
    items = [(name.partition("#")[0], fields) for name, fields in load_datagrams()]
    for (name, sent), (_, following) in pairwise([*items, ("", {})]):
        if sent["wkc"] or not following:
            continue  # an answer, or the end of the file, where the answer was cut off
        keys = ("command", "index", "ado")
        is_answer = all(sent[key] == following[key] for key in keys)
        answer = following if is_answer and following["wkc"] else None
        found.setdefault(name, []).append((sent, answer or {**sent, "data": None}))
    return found


@pytest.mark.parametrize("name", sorted(captures()))
def test_capture_replays_with_the_same_working_counters(name):
    escs = [Esc(IMAGE, each) for each in settings_of(name)]
    chain = Chain(escs)
    answered = 0
    for sent, answer in captures()[name]:
        if sent["command"].startswith("FP"):
            escs[0].write(0x0010, u16(sent["adp"]), 0)
            chain = Chain(escs)
        got = send(chain, Command[sent["command"]], sent["adp"], sent["ado"],
                   bytes.fromhex(sent["data"]))  # fmt: skip
        assert got.wkc == answer["wkc"], sent
        answered += answer["wkc"] > 0
        if answer["wkc"]:
            assert got.adp == answer["adp"], sent
    assert answered >= 4


@pytest.mark.parametrize(
    ("ado", "size"), [(0x0120, 2), (0x0010, 2), (0x080D, 2), (0x0805, 1), (0x0300, 8), (0x0110, 2)]
)
def test_captured_data_of_a_lan9252(ado, size):
    """Return the answer of the capture's slave, with its station address and wiring."""
    escs = [Esc(IMAGE, EscSettings(type=0xC0, revision=2, fmmus=3, sync_managers=4))]
    escs[0].set_dl_status(0x5617)
    chain = Chain(escs)
    data = {}
    for sent, answer in captures()["soem-single-lan9252"]:
        got = send(chain, Command[sent["command"]], sent["adp"], sent["ado"],
                   bytes.fromhex(sent["data"]))  # fmt: skip
        if sent["ado"] == ado and "RD" in sent["command"]:
            data[sent["ado"]] = got.data.hex(), answer["data"]
    for found, expected in data.values():
        assert found == expected, size
