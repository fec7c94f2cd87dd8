"""A slave that lies: whatever it sends ends in a named error in time, and the bus runs on."""

from __future__ import annotations

import io
import itertools
import re
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import pytest

from devicebus.errors import (
    BusError,
    FoeError,
    MailboxProtocolError,
    MailboxRefusedError,
    MailboxTimeoutError,
    SoeError,
)
from devicebus.mailbox import aoe_client, coe_client, eoe, foe_client, soe_client, voe
from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.server import MailboxServer
from devicebus.master.bus import SlaveBack, SlaveFailed
from devicebus.master.master import LOOK_NS, Master
from devicebus.sim.spec import MailboxSpec
from eap.codec.ams import AmsHeader, encode_packet
from eap.codec.mailbox import MailboxHeader, MailboxType, encode_message
from eap.codec.soe import Idn
from eap.ids import NetId
from eap.od.abort import SdoAbortError
from tests.support.busline import MS, Paced, segment, slave

AOE, EOE, COE = MailboxType.AOE, MailboxType.EOE, MailboxType.COE
FOE, SOE, VOE = MailboxType.FOE, MailboxType.SOE, MailboxType.VOE
EVIL = 1002
SECOND = 1000 * MS
VENDOR = b"\x5a\x0e\0\0"
MODE, RESET = Idn.parse("S-0-0032"), Idn.parse("S-0-0099")
HERE, THERE = NetId.parse("1.2.3.4.5.6"), NetId.parse("127.0.0.1.3.1")
BLOCK = "0030 41 1810 01 00000100 01"
"""One byte of 65536."""


class Evil(MailboxServer):
    """A mailbox that answers with what *script* says as soon as there was a request.

    A text is the data of a message in hexadecimal, in the protocol of the request; bytes are a
    whole message as it lies in the mailbox.
    """

    def __init__(self, server: MailboxServer) -> None:
        super().__init__(server.protocols, server.sizes)
        self.script: Iterator[str | bytes] | None = None
        self.kind = COE
        self.is_asked = False

    def receive_message(self, message: bytes, now_ns: int) -> None:
        if self.script is None:
            super().receive_message(message, now_ns)
        self.is_asked = True

    def next_message(self, now_ns: int) -> bytes | None:
        if self.script is None:
            return super().next_message(now_ns)
        said = next(self.script, None) if self.is_asked else None
        self.is_asked = isinstance(said, bytes)  # raw messages come in a row
        if isinstance(said, str):
            self._enqueue(self.kind, bytes.fromhex(said), 0)
            return super().next_message(now_ns)
        return said


@pytest.fixture
def line() -> Paced:
    mailbox = MailboxSpec(foe=True, soe=True, eoe=True, voe=True, aoe=True)
    evil = slave("evil", mailbox=mailbox)
    line = Paced(Master(), segment(slave("good"), evil, slave("other")))
    line.period_ns = 4 * MS  # seconds of time-outs pass sooner
    line.wait(line.core.bring_up(line.now_ns))
    device = line.segment.slaves[1].device
    device.mailbox = line.evil = Evil(device.mailbox)
    line.elapse(20 * MS)
    return line


class Case(NamedTuple):
    """One case: the request, the slave's reply, and the expected result."""

    kind: MailboxType
    ask: Callable[[MailboxSizes], Conversation]
    said: Iterable[str | bytes]
    error: type[Exception]
    text: str
    limit_ns: int = 5 * SECOND


def upload(_: MailboxSizes) -> Conversation:
    return coe_client.upload(0x1018, 1)


def download(sizes: MailboxSizes) -> Conversation:
    return coe_client.download(0x1018, 1, bytes(1000), sizes)


def listed(_: MailboxSizes) -> Conversation:
    return coe_client.object_list()


def get(sizes: MailboxSizes) -> Conversation:
    return foe_client.read("f", bytearray().extend, sizes)


def put(sizes: MailboxSizes) -> Conversation:
    return foe_client.write("f", io.BytesIO(bytes(1000)).read, sizes)


def idn(_: MailboxSizes) -> Conversation:
    return soe_client.read(MODE)


def command(sizes: MailboxSizes) -> Conversation:
    return soe_client.execute(RESET, sizes, timeout_ns=SECOND)


def ip(_: MailboxSizes) -> Conversation:
    return eoe.get_ip()


def other_vendor(_: MailboxSizes) -> Conversation:
    return voe.exchange(1, 2, b"x")


def ams(sizes: MailboxSizes) -> Conversation:
    return aoe_client.exchange(AmsHeader(THERE, EVIL, HERE, 300, 4, invoke_id=7), b"", sizes)


def packet(
    command_: int, flags: int, data: bytes, *, length: int | None = None, invoke_id: int = 7
) -> str:
    octets = bytearray(
        encode_packet(AmsHeader(HERE, 300, THERE, EVIL, command_, flags, invoke_id=invoke_id), data)
    )
    if length is not None:
        octets[20:24] = length.to_bytes(4, "little")
    return octets.hex()


def message(kind: int, data: str, *, counter: int = 0, length: int | None = None) -> bytes:
    """Bytes as they lie in the mailbox; counter 0 is never taken for a repetition."""
    octets = bytes.fromhex(data)
    head = MailboxHeader(0, type=MailboxType.COE, counter=counter)
    whole = bytearray(encode_message(head, octets))
    whole[5] = counter << 4 | kind
    if length is not None:
        whole[:2] = length.to_bytes(2, "little")
    return bytes(whole)


def segments(data: str, flags: int = 0) -> Iterator[str]:
    yield BLOCK
    for number in itertools.count():
        yield f"0030 {flags | (number & 1) << 4:02x} {data}"


CASES = {
    "silence": Case(COE, upload, [], MailboxTimeoutError, "no COE reply within 2000 ms"),
    "no message at all": Case(COE, upload, [b""], MailboxProtocolError, "error of 0 bytes"),
    "length beyond the mailbox": Case(
        COE, upload, [message(3, "0030", length=0xFFFF)], MailboxTimeoutError, "no COE reply"
    ),
    "unknown type": Case(COE, upload, [message(9, "0030")], MailboxTimeoutError, "no COE reply"),
    "other protocol": Case(
        COE, upload, [message(4, "0400 00000000")], MailboxTimeoutError, "no COE reply"
    ),
    "unknown mailbox error": Case(
        COE, upload, [message(0, "0100 7777")], MailboxRefusedError, "mailbox error 0x7777"
    ),
    "cut mailbox error": Case(COE, upload, [message(0, "01")], MailboxProtocolError, "expected 4"),
    "same message for ever": Case(
        COE, upload, itertools.repeat(message(3, "0030 43 1910 01 00000000", counter=3)),
        MailboxTimeoutError, "no COE reply",
    ),
    "answers to others for ever": Case(
        COE, upload, itertools.repeat(message(3, "0030 43 1910 01 00000000")),
        MailboxTimeoutError, "no COE reply",
    ),
    "emergencies for ever": Case(
        COE, upload, itertools.repeat(message(3, "0010 0010 01 0000000000")),
        MailboxTimeoutError, "no COE reply",
    ),
    "cut SDO": Case(COE, upload, ["0030 43 18"], MailboxProtocolError, "needs 8 bytes"),
    "object of 4 GiB": Case(
        COE, upload, ["0030 41 1810 01 ffffffff"], MailboxProtocolError, "4294967295 bytes"
    ),
    "other object": Case(
        COE, upload, ["0030 43 1910 01 00000000"], MailboxTimeoutError, "no COE reply"
    ),
    "other service": Case(
        COE, upload, ["0030 60 1810 01 00000000"], MailboxTimeoutError, "no COE reply"
    ),
    "unknown abort": Case(
        COE, upload, ["0020 80 1810 01 efbeadde"], SdoAbortError, "0xDEADBEEF"
    ),
    "segment too long": Case(
        COE, upload, ["0030 41 1810 01 05000000 01", "0030 00 0102030405060708"],
        MailboxProtocolError, "more than the 5 bytes",
    ),
    "last segment too soon": Case(
        COE, upload, [BLOCK, "0030 01 01020304050607"], MailboxProtocolError, "8 bytes of 65536"
    ),
    "segment out of order": Case(
        COE, upload, [BLOCK, "0030 10 01020304050607"], MailboxTimeoutError, "no COE reply"
    ),
    "endless empty segments": Case(
        COE, upload, segments(""), MailboxProtocolError, "without data"
    ),
    "endless short segments": Case(
        COE, upload, segments("01000000000000", 0x0C),
        MailboxProtocolError, "1001 short segments",
    ),
    "confirmation of another segment": Case(
        COE, download, ["0030 60 1810 01 00000000", "0030 30 00000000000000"],
        MailboxTimeoutError, "no COE reply",
    ),
    "list with a hole": Case(
        COE, listed, [message(3, "0080 82 00 0900 0100 0010"), message(3, "0080 82 00 0300 0110")],
        MailboxProtocolError, "9 fragments left, then 3",
    ),
    "list that grows": Case(
        COE, listed,
        itertools.chain([message(3, "0080 82 00 0200 0100 0010")],
                        itertools.repeat(message(3, "0080 82 00 ffff 0110"))),
        MailboxProtocolError, "2 fragments left, then 65535",
    ),
    "half an index": Case(
        COE, listed, ["0080 02 00 0000 0100 10"], MailboxProtocolError, "expected whole indexes"
    ),
    "packet 0": Case(FOE, get, ["0300 00000000 61"], MailboxProtocolError, "packet 0, expected 1"),
    "packet from the future": Case(
        FOE, get, ["0300 01000000" + "61" * 244, "0300 07000000 61"],
        MailboxProtocolError, "packet 7, expected 2",
    ),
    "same packet for ever": Case(
        FOE, get, itertools.repeat("0300 01000000" + "61" * 244),
        MailboxTimeoutError, "no FOE reply within 3000 ms",
    ),
    "cut FoE": Case(FOE, get, ["0300 0100"], MailboxProtocolError, "needs 6 bytes"),
    "unknown FoE error": Case(FOE, get, ["0500 77770000"], FoeError, "0x7777"),
    "unknown FoE opcode": Case(FOE, get, ["0900 01000000"], MailboxTimeoutError, "no FOE reply"),
    "endless busy": Case(
        FOE, put, itertools.repeat("0600 00000000"), MailboxTimeoutError, "still busy after 100",
        3 * SECOND,
    ),
    "confirmation from the future": Case(
        FOE, put, ["0400 00000000", "0400 09000000"], MailboxProtocolError, "packet 9 acknowledged"
    ),
    "cut SoE": Case(SOE, idn, ["0240 20"], MailboxProtocolError, "needs 4 bytes"),
    "fragments with a hole": Case(
        SOE, idn, [message(5, "0a40 0900 01"), message(5, "0a40 0300 01")],
        MailboxProtocolError, "9 fragments left, then 3",
    ),
    "fragments for ever": Case(
        SOE, idn, itertools.repeat(message(5, "0a40 0900 01")),
        MailboxProtocolError, "answers for other IDNs|9 fragments left",
    ),
    "SoE error without a code": Case(SOE, idn, ["1240 2000"], MailboxProtocolError, "an error of"),
    "unknown SoE error": Case(SOE, idn, ["1240 2000 7777"], SoeError, "0x7777"),
    "endless command": Case(
        SOE, command, itertools.chain(["0440 6300"], itertools.repeat("0201 6300 0700")),
        MailboxTimeoutError, "not done after 1 s",
    ),
    "cut EoE": Case(EOE, ip, ["07"], MailboxProtocolError, "needs"),
    "settings that are not there": Case(
        EOE, ip, ["0700 0000 3f000000 0102"], MailboxProtocolError, "not all there"
    ),
    "unknown EoE type": Case(EOE, ip, ["0f00 0000"], MailboxTimeoutError, "no EOE reply"),
    "other vendor": Case(VOE, other_vendor, ["090000000200"], MailboxTimeoutError, "no VOE reply"),
    "no vendor": Case(VOE, other_vendor, ["01"], MailboxTimeoutError, "no VOE reply"),
    "cut AMS header": Case(AOE, ams, ["0102"], MailboxProtocolError, "AoE answer of"),
    "AMS length": Case(
        AOE, ams, [packet(4, 5, b"ab", length=3)], MailboxProtocolError, "but 2 bytes follow"
    ),
    "AMS packet of 4 GiB in fragments": Case(
        AOE, ams, [packet(0x0902, 6, b"\4\0\5\0\xff\xff\xff\xff\0\0\0\0\7\0\0\0", invoke_id=0)],
        MailboxProtocolError, "bytes too long",
    ),
    "AMS fragments with a hole": Case(
        AOE, ams, [message(1, packet(0x0902, 6, b"\4\0\5\0", invoke_id=0)),
                   message(1, packet(0x0902, 6, b"\0\0\0\0", invoke_id=2))],
        MailboxProtocolError, "fragment 2 of packet 0 out of order",
    ),
    "AMS fragments without a first for ever": Case(
        AOE, ams, itertools.repeat(message(1, packet(0x0902, 6, b"\0\0\0\0", invoke_id=2))),
        MailboxProtocolError, "16 fragments of other answers",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_lies_end_in_named_errors_in_time_and_the_bus_runs_on(
    line: Paced, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(foe_client, "BUSY_LIMIT", 100)
    case = CASES[name]
    master = line.core
    before = master.cycle.stats()
    line.evil.kind, line.evil.script = case.kind, iter(case.said)
    started_ns = line.now_ns
    talk = case.ask(master.slaves[EVIL].mailbox.sizes)
    task = master.converse(EVIL, talk, line.now_ns, name=name)
    with pytest.raises(case.error, match=case.text):
        line.wait(task, 200 * SECOND)
    assert line.now_ns - started_ns <= case.limit_ns
    line.elapse(2 * LOOK_NS)  # an answer that came too late is read, and not taken for the next one
    line.evil.script = None
    sizes = MailboxSizes(256, 256)
    fine = master.converse(EVIL, upload(sizes), line.now_ns)
    assert line.wait(fine) == VENDOR
    master.image.write(1001, "out", True)
    line.elapse(5 * MS)
    assert line.segment.slaves[0].device.dictionary.entry(0x7000, 1).value
    after = master.cycle.stats()
    assert after.cycles > before.cycles
    assert after.good - before.good >= after.cycles - before.cycles - 1
    assert (after.wkc_errors, after.lost) == (before.wkc_errors, before.lost)
    assert isinstance(task.error, BusError | SdoAbortError)


EEPROMS = {
    "category without end": ("0a00 ff0f", "EEPROM category 10 ends at byte"),
    "more strings than there are": ("0a00 0200 ff 01 61 00 ffff", "string|StringCount"),
    "string longer than its category": ("0a00 0200 01 c8 6161 ffff", "a string of 200 bytes"),
    "PDO without its entries": ("3200 0400 001a ff 03 0000 0000 ffff", "SiiPdoEntry"),
    "cut general category": ("1e00 0100 0000 ffff", "SiiGeneral"),
}
"""Content in place of the EEPROM categories, and the message about it."""


def tamper(line: Paced, text: str) -> bytes:
    """Put bytes in the place of the second slave's categories; return what there was."""
    image = line.segment.slaves[1].esc.eeprom.image
    before = bytes(image)
    image[128:] = bytes.fromhex(text).ljust(len(image) - 128, b"\0")
    return before


@pytest.mark.parametrize("name", EEPROMS)
def test_an_eeprom_that_lies_is_named_and_the_others_are_found(line: Paced, name: str) -> None:
    text, reason = EEPROMS[name]
    before = tamper(line, text)
    found = line.wait(line.core.scan(line.now_ns))
    assert [bool(each.fault) for each in found] == [False, True, False]
    assert re.search(f"slave 1002: its EEPROM cannot be used: .*({reason})", found[1].fault)
    with pytest.raises(BusError, match=f"slave 1002: .*({reason})"):
        line.wait(line.core.bring_up(line.now_ns))
    line.segment.slaves[1].esc.eeprom.image[:] = before
    line.wait(line.core.bring_up(line.now_ns))
    assert line.core.cycle.is_good


def test_a_mailbox_that_lies_over_the_registers_is_no_mailbox(line: Paced) -> None:
    """Sizes and places from the EEPROM are not believed blindly."""
    image = line.segment.slaves[1].esc.eeprom.image
    image[0x30:0x38] = bytes.fromhex("0000 ffff 0008 ffff")
    with pytest.raises(BusError, match="slave 1002: its mailbox of 65535 bytes at 0x0000 cannot"):
        line.wait(line.core.bring_up(line.now_ns))


def test_slave_back_with_a_false_eeprom_disturbs_no_other(line: Paced) -> None:
    line.segment.switch(1, on=False)
    line.elapse(300 * MS)
    line.events()
    image = line.segment.slaves[1].esc.eeprom.image
    identity = bytes(image[16:32])
    image[16:32] = b"\xff" * 16
    line.segment.switch(1, on=True)
    line.elapse(3 * SECOND)
    failed = [each for each in line.events() if isinstance(each, SlaveFailed)]
    assert 2 <= len(failed) <= 4
    assert "in place of evil (station 1002) there is vendor 0xFFFFFFFF" in failed[0].reason
    before = line.core.cycle.stats()
    line.elapse(100 * MS)
    after = line.core.cycle.stats()
    assert after.good - before.good >= after.cycles - before.cycles - 1
    image[16:32] = identity
    line.elapse(3 * SECOND)
    assert [each.station for each in line.events() if isinstance(each, SlaveBack)] == [EVIL]
