"""Conversations byte for byte, with slaves that do not behave, and with ours on a bad line."""

from __future__ import annotations

import itertools
from contextlib import suppress
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule

from devicebus.errors import BusError, MailboxProtocolError, MailboxTimeoutError, SoeError
from devicebus.mailbox import soe_client
from devicebus.mailbox.conversation import MailboxMessage, Progress
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.soe_client import IdnDescription
from devicebus.mailbox.soe_server import ProcedureCommand, SoeParameter, SoeServer
from eap.codec.mailbox import MailboxType
from eap.codec.soe import Display, Element, Idn, SoeAttribute, SoeErrorCode, encode_list
from eap.od.model import OdState
from tests.support.examples import examples
from tests.support.mailbox import Fault, Line, open_line, run_with, talk_to

SOE = MailboxType.SOE
SIZES = MailboxSizes(16, 16)
MODE, AT_LIST, TEXT, RESET = map(Idn.parse, ("S-0-0032", "S-0-0016", "P-0-0140", "S-0-0099"))


def test_soe_read_of_one_message() -> None:
    read, asked = run_with(SOE, soe_client.read(MODE, drive=1), ["22 40 2000 0b000000"])
    assert (read, asked) == (b"\x0b\0\0\0", [bytes.fromhex("21 40 2000")])
    elements = Element.NAME | Element.UNIT
    _, asked = run_with(SOE, soe_client.read(MODE, elements), ["02 0a 2000"])
    assert asked == [bytes.fromhex("01 0a 2000")]


def test_read_in_fragments() -> None:
    progress = Progress()
    answers = ["0a 40 0200 0a0028000001", "0a 40 0100 020304050607", "02 40 1000 0809"]
    talk = soe_client.read(AT_LIST, progress=progress)
    read, asked = run_with(SOE, talk, answers)
    assert read == bytes.fromhex("0a002800") + bytes(range(10))
    assert (len(asked), progress.done) == (1, 14)


def test_late_messages_are_not_taken() -> None:
    answers = [
        "05 01 6300 0300",
        "22 40 2000 99999999",
        "04 40 2000",
        "02 40 2100 99999999",
        "12 40 2100 0110",
        "0a 40 0200 999999999999",
        "0a 40 0100 999999999999",
        "12 40 2100 0110",
        "0a 40 0100 999999999999",
        "0a 40 0300 010203040506",
        "0a 40 0200 0708",
        "0a 40 0100 09",
        "02 40 2000 0a",
    ]
    assert talk_to(SOE, soe_client.read(MODE), *answers) == bytes(range(1, 11))


def test_soe_client_refusal_is_raised_with_its_code() -> None:
    with pytest.raises(
        SoeError, match=r"SoE read of S-0-0032 at drive 2: no unit \(0x4001\)"
    ) as caught:
        talk_to(SOE, soe_client.read(MODE, Element.UNIT, drive=2), "52 08 2000 0000 0140")
    assert caught.value.code == SoeErrorCode.NO_UNIT
    with pytest.raises(SoeError, match=r"SoE write of S-0-0032 at drive 0: value is read only"):
        talk_to(SOE, soe_client.write(MODE, b"\1", SIZES), "14 40 2000 0470")


@pytest.mark.parametrize(
    ("answers", "reason"),
    [
        (["02"], "needs 4 bytes"),
        (["12 40 2000 01"], "an error of 1 bytes"),
        (["0a 40 0300 01", "0a 40 0100 02"], "3 fragments left, then 1"),
        (["0a 40 0300 01", "0a 40 0300 02"], "3 fragments left, then 3"),
        (["0a 40 0300 01", "02 40 2000 02"], "3 fragments left, then 0"),
        (["0a 40 0100 01", "02 40 2100 02"] * 17, "17 answers for other IDNs"),
        (["0a 40 0100 01", "0a 40 0200 02"] * 18, "17 answers for other IDNs"),
    ],
)
def test_read_that_breaks_the_protocol(answers: list[str], reason: str) -> None:
    with pytest.raises(MailboxProtocolError, match=reason):
        talk_to(SOE, soe_client.read(MODE), *answers)


def test_soe_client_endless_fragments_end_with_the_limit() -> None:
    answers = (f"0a 40 {n & 255:02x}{n >> 8:02x} {'00' * 1000}" for n in range(0xFFFF, 0, -1))
    with pytest.raises(MailboxProtocolError, match="more than 524320 bytes"):
        talk_to(SOE, soe_client.read(MODE), *itertools.islice(answers, 600))


@pytest.mark.parametrize(
    ("data", "sent"),
    [
        (b"", ["23 40 2000"]),
        (b"\1\2\3\4", ["23 40 2000 01020304"]),
        (bytes(range(6)), ["23 40 2000 000102030405"]),
        (bytes(range(8)), ["2b 40 0100 000102030405", "23 40 2000 0607"]),
        (
            bytes(range(18)),
            ["2b 40 0200 000102030405", "2b 40 0100 060708090a0b", "23 40 2000 0c0d0e0f1011"],
        ),
    ],
)
def test_soe_client_writes_in_fragments(data: bytes, sent: list[str]) -> None:
    progress = Progress()
    talk = soe_client.write(MODE, data, SIZES, drive=1, progress=progress)
    _, asked = run_with(SOE, talk, ["24 40 2000"])
    assert asked == [bytes.fromhex(octets) for octets in sent]
    assert (progress.done, progress.total) == (len(data), len(data))


def test_soe_refused_fragment_has_any_idn() -> None:
    with pytest.raises(SoeError, match="value is too long"):
        talk_to(SOE, soe_client.write(MODE, bytes(8), SIZES), "14 40 0100 0370")


def test_answer_to_a_write_that_breaks_the_protocol() -> None:
    with pytest.raises(MailboxProtocolError, match="answered for"):
        talk_to(SOE, soe_client.write(MODE, bytes(8), SIZES), "0c 40 2000")
    with pytest.raises(MailboxTimeoutError):
        talk_to(SOE, soe_client.write(MODE, bytes(8), SIZES), "04 40 0100")


def test_procedure_command_is_started_watched_and_cleared() -> None:
    answers = ["04 40 6300", "02 01 6300 0700", "02 01 6300 0700", "02 01 6300 0300", "04 40 6300"]
    _, asked = run_with(SOE, soe_client.execute(RESET, SIZES), answers)
    assert [data.hex(" ") for data in asked] == [
        "03 40 63 00 03 00",
        *["01 01 63 00"] * 3,
        "03 40 63 00 00 00",
    ]


@pytest.mark.parametrize(
    ("states", "error", "reason"),
    [
        (["0f00"], SoeError, "procedure command S-0-0099 at drive 0: failed"),
        (["0700"] * 3, MailboxTimeoutError, "not done after 0.03 s"),
    ],
)
def test_procedure_command_that_fails_is_cleared_too(
    states: list[str], error: type[Exception], reason: str
) -> None:
    answers = ["04 40 6300", *(f"02 01 6300 {state}" for state in states), "04 40 6300"]
    asked: list[bytes] = []

    def watch() -> soe_client.Conversation[None]:
        talk = soe_client.execute(RESET, SIZES, timeout_ns=30_000_000)
        ask = next(talk)
        while True:
            asked.append(ask.request)
            ask = talk.send((yield ask))

    with pytest.raises(error, match=reason):
        talk_to(SOE, watch(), *answers)
    assert asked[-1] == bytes.fromhex("03 40 6300 0000")


def test_execute_slow_busy_answers_time_out() -> None:
    talk = soe_client.execute(RESET, SIZES, timeout_ns=30_000_000_000)
    next(talk)
    ask = talk.send(MailboxMessage(SOE, bytes.fromhex("04 40 6300")))
    polls = 0
    while ask.request[0] == 1:
        ask = talk.send(
            MailboxMessage(SOE, bytes.fromhex("02 01 6300 0700"), polls * 1_900_000_000)
        )
        polls += 1
    assert polls == 17
    assert ask.request == bytes.fromhex("03 40 6300 0000")


def test_procedure_command_that_is_neither_done_nor_cleared() -> None:
    busy = ["04 40 6300", *["02 01 6300 0700"] * 3]
    with pytest.raises(MailboxTimeoutError, match=r"not done after 0\.03 s"):
        talk_to(SOE, soe_client.execute(RESET, SIZES, timeout_ns=30_000_000), *busy)
    with pytest.raises(MailboxTimeoutError, match="no answer"):
        talk_to(SOE, soe_client.execute(RESET, SIZES), busy[0], "02 01 6300 0300")


def test_data_state_that_is_cut_breaks_the_protocol() -> None:
    with pytest.raises(MailboxProtocolError, match="a data state of 1 bytes"):
        talk_to(SOE, soe_client.execute(RESET, SIZES), "04 40 6300", "02 01 6300 07")


@given(st.lists(st.binary(max_size=12), max_size=20), st.booleans())
def test_soe_client_any_answers_end_in_data_or_an_error(noise: list[bytes], is_read: bool) -> None:
    talk = soe_client.read(MODE) if is_read else soe_client.write(MODE, bytes(8), SIZES)
    with suppress(BusError):
        talk_to(SOE, talk, *noise)


def serve(sizes: MailboxSizes, dice: Random | None) -> Line:
    text = SoeAttribute(length=0, is_list=1, display=Display.TEXT)
    command = SoeAttribute(length=1, is_command=1, display=Display.BINARY)
    drives = {
        drive: [
            SoeParameter("S-0-0032", "Mode", SoeAttribute(), drive),
            SoeParameter("P-0-0140", "Text", text, max_length=2000),
            SoeParameter(
                "S-0-0099", "Reset", command, procedure=ProcedureCommand(duration_ns=70_000_000)
            ),
        ]
        for drive in (0, 5)
    }
    server = SoeServer(drives, lambda: OdState.OP, sizes)
    bad = [Fault.NONE] * 6 + list(Fault)
    return open_line(SOE, server, sizes, lambda: dice.choice(bad) if dice else Fault.NONE)


@examples(60)
@given(
    st.binary(max_size=1200),
    st.integers(16, 128),
    st.integers(16, 128),
    st.integers(0, 1 << 30),
)
def test_soe_client_reads_written_data_over_a_bad_line(
    data: bytes, to_slave: int, to_master: int, seed: int
) -> None:
    sizes = MailboxSizes(to_slave, to_master)
    line = serve(sizes, Random(seed))
    line.run(soe_client.write(TEXT, encode_list(data), sizes, drive=5))
    assert line.run(soe_client.read(TEXT, drive=5)) == encode_list(data, 2000)


def test_procedure_command_of_our_drive() -> None:
    line = serve(SIZES, None)
    for _ in range(2):
        line.run(soe_client.execute(RESET, SIZES, drive=5))
    assert line.now_ns >= 140_000_000
    assert {message.data[:4] for message in line.fetch()} <= {bytes.fromhex("a5 01 6300")}


class SoeMachine(RuleBasedStateMachine):
    """Reads, writes, commands, refusals and cancelled ones, in any order, over a bad line."""

    def __init__(self) -> None:
        super().__init__()
        self.sizes = MailboxSizes(22, 18)
        self.line = serve(self.sizes, Random(9))
        self.texts = {0: b"", 5: b""}
        self.modes = {0: 0, 5: 5}

    @rule(drive=st.sampled_from([0, 5]), data=st.binary(max_size=100))
    def write_text(self, drive: int, data: bytes) -> None:
        self.line.run(soe_client.write(TEXT, encode_list(data), self.sizes, drive=drive))
        self.texts[drive] = data

    @rule(drive=st.sampled_from([0, 5]))
    def read_text(self, drive: int) -> None:
        read = self.line.run(soe_client.read(TEXT, drive=drive))
        assert read == encode_list(self.texts[drive], 2000)

    @rule(drive=st.sampled_from([0, 5]), mode=st.integers(0, 0xFFFFFFFF))
    def write_mode(self, drive: int, mode: int) -> None:
        data = mode.to_bytes(4, "little")
        self.line.run(soe_client.write(MODE, data, self.sizes, drive=drive))
        self.modes[drive] = mode

    @rule(drive=st.sampled_from([0, 5]))
    def read_mode(self, drive: int) -> None:
        read = self.line.run(soe_client.read(MODE, drive=drive))
        assert int.from_bytes(read, "little") == self.modes[drive]

    @rule()
    def refused(self) -> None:
        with pytest.raises(SoeError, match="invalid drive number"):
            self.line.run(soe_client.read(MODE, drive=1))

    @rule(drive=st.sampled_from([0, 5]))
    def executed(self, drive: int) -> None:
        self.line.run(soe_client.execute(RESET, self.sizes, drive=drive))

    @rule(drive=st.sampled_from([0, 5]), steps=st.integers(0, 4))
    def cancelled_read(self, drive: int, steps: int) -> None:
        self.line.run_partly(soe_client.read(TEXT, drive=drive), steps)


TestSoeMachine = SoeMachine.TestCase
TestSoeMachine.settings = examples(25, stateful_step_count=25)


SPEED = SoeAttribute(length=2, display=Display.SIGNED, decimals=1)
AXES = SoeAttribute(length=1, is_list=1, display=Display.UNSIGNED)


def serve_drive() -> Line:
    sizes = MailboxSizes(20, 20)
    parameters = [
        SoeParameter("S-0-0036", "Velocity", SPEED, -5, unit="rpm", limits=(-100, 200)),
        SoeParameter("P-0-0001", "", AXES, [1, 2, 3]),
    ]
    return open_line(SOE, SoeServer({2: parameters}, lambda: OdState.OP, sizes), sizes)


def test_list_of_all_idns() -> None:
    listed = serve_drive().run(soe_client.idn_list(drive=2))
    assert [str(idn) for idn in listed] == ["S-0-0017", "S-0-0036", "P-0-0001"]


def test_idn_with_every_element() -> None:
    idn = Idn.parse("S-0-0036")
    described = serve_drive().run(soe_client.describe(idn, drive=2))
    assert described == IdnDescription(idn, SPEED, -5, "Velocity", "rpm", -100, 200, -5)


def test_idn_with_few_elements() -> None:
    idn = Idn.parse("P-0-0001")
    described = serve_drive().run(soe_client.describe(idn, drive=2))
    assert described == IdnDescription(idn, AXES, [1, 2, 3], default=[1, 2, 3])


def test_soe_describe_unknown_idn_is_refused() -> None:
    with pytest.raises(SoeError, match="S-0-0099 at drive 2: no such IDN"):
        serve_drive().run(soe_client.describe(Idn.parse("S-0-0099"), drive=2))


@pytest.mark.parametrize(
    ("answers", "reason"),
    [
        (["02 04 2400 0100"], "attribute of S-0-0036"),
        (["02 04 2400 01002200", "02 40 2400 01", *["12 40 2400 0120"] * 6], "elements of"),
        (["02 04 2400 01002200", "02 40 2400 00000000", "02 02 2400 05000500"], "elements of"),
    ],
)
def test_answer_that_breaks_the_protocol(answers: list[str], reason: str) -> None:
    refusals = ["12 00 2400 0120"] * 6
    with pytest.raises(MailboxProtocolError, match=reason):
        talk_to(SOE, soe_client.describe(Idn.parse("S-0-0036")), *answers, *refusals)


def test_list_that_is_no_list_breaks_the_protocol() -> None:
    for answer in ("02 40 1100 0300 0300 010002", "02 40 1100 0400 0400 0100"):
        with pytest.raises(MailboxProtocolError, match="IDN list S-0-0017"):
            talk_to(SOE, soe_client.idn_list(), answer)


@given(st.lists(st.binary(max_size=12), max_size=10))
def test_soe_client_any_answers_end_in_a_description_or_an_error(noise: list[bytes]) -> None:
    answers = [b"\2\4\x24\0" + octets for octets in noise]
    with suppress(BusError):
        talk_to(SOE, soe_client.describe(Idn.parse("S-0-0036")), *answers)
