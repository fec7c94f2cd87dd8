"""Conversations byte for byte, with slaves that do not behave, and with ours on a bad line."""

from __future__ import annotations

import itertools
from contextlib import suppress
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule

from devicebus.errors import (
    BusError,
    MailboxProtocolError,
    MailboxRefusedError,
    MailboxTimeoutError,
)
from devicebus.mailbox import coe_client
from devicebus.mailbox.coe_server import CoeServer
from devicebus.mailbox.conversation import Progress
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.coe import CoeService, EntryDescription, ObjectDescription
from eap.codec.mailbox import MailboxType
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.info import ListType
from eap.od.model import (
    RO,
    RW,
    Access,
    Entry,
    ObjectCode,
    OdObject,
    OdState,
    array,
    record,
    variable,
)
from tests.support.examples import examples
from tests.support.mailbox import Fault, Line, open_line, run_with, talk_to

COE = MailboxType.COE
SIZES = MailboxSizes(32, 32)
FOUR = "0030 41 1810 01 04000000 01"
"""One byte of four."""


@pytest.mark.parametrize(
    ("answer", "data"),
    [
        ("0030 43 1810 01 02000000", b"\2\0\0\0"),
        ("0030 4f 1810 01 02000000", b"\2"),
        ("0030 42 1810 01 02000000", b"\2\0\0\0"),
        ("0030 4e 1810 01 02000000", b"\2\0\0\0"),
        ("0030 53 1810 01 02000000", b"\2\0\0\0"),
        ("0030 41 1810 01 06000000 454b31393134", b"EK1914"),
        ("0030 41 1810 01 02000000 454b31393134", b"EK"),
        ("0030 41 1810 01 00000000", b""),
    ],
)
def test_upload_of_one_message(answer: str, data: bytes) -> None:
    read, asked = run_with(COE, coe_client.upload(0x1018, 1), [answer])
    assert read == data
    assert asked == [bytes.fromhex("0020 40 1810 01 00000000")]


def test_upload_in_segments() -> None:
    progress = Progress()
    answers = [
        "0030 51 1810 00 0b000000 0102",
        "0030 00 03040506070809",
        "0030 1b 0a0b0000000000",
    ]
    talk = coe_client.upload(0x1018, 0, complete=True, progress=progress)
    read, asked = run_with(COE, talk, answers)
    assert read == bytes(range(1, 12))
    assert (progress.done, progress.total) == (11, 11)
    assert [data.hex() for data in asked] == [
        "00205018100000000000",
        "00206000000000000000",
        "00207000000000000000",
    ]


def test_late_and_unsolicited_messages_are_not_taken() -> None:
    answers = [
        "0030 43 1810 02 99999999",
        "0030 43 1910 01 99999999",
        "0030 60 1810 01 99999999",
        "0030 00 99999999999999",
        "0010 1023 03 0102030405",
        "0020 80 1810 02 00000206",
        "0090",
        "",
        "0030 41 1810 01 08000000 01",
        "0030 43 1810 01 99999999",
        "0010 1023 03 0102030405",
        "0030 10 99999999999999",
        "0030 01 02030405060708",
    ]
    assert talk_to(COE, coe_client.upload(0x1018, 1), *answers) == bytes(range(1, 9))


@pytest.mark.parametrize("service", ["0020", "0030"])
def test_sdo_abort_is_raised_with_its_code(service: str) -> None:
    with pytest.raises(SdoAbortError, match=r"0x1018:05: subindex does not exist") as caught:
        talk_to(COE, coe_client.upload(0x1018, 5), f"{service} 80 1810 05 11000906")
    assert caught.value.code == AbortCode.NO_SUBINDEX


def test_abort_between_segments() -> None:
    answers = ["0030 41 1810 01 08000000 01", "0020 80 1810 01 00000008"]
    with pytest.raises(SdoAbortError, match="general error"):
        talk_to(COE, coe_client.upload(0x1018, 1), *answers)


@pytest.mark.parametrize(
    ("answers", "reason", "abort"),
    [
        (["0030"], "needs 8 bytes", None),
        (["0030 43 1810 01 0000"], "needs 8 bytes", None),
        (["0030 41 1810 01 ffffffff"], "4294967295 bytes, at most", AbortCode.OUT_OF_MEMORY),
        ([FOUR, "0030"], "needs 1 bytes", None),
        ([FOUR, "0030 00"], "without data", AbortCode.GENERAL),
        ([FOUR, "0030 0e 01020304050607"], "without data", AbortCode.GENERAL),
        ([FOUR, "0030 00 01020304"], "more than the 4", AbortCode.TOO_LONG),
        ([FOUR, "0030 0b 01020304050607"], "3 bytes of 4", None),
    ],
)  # fmt: skip
def test_answer_that_breaks_the_protocol(
    answers: list[str], reason: str, abort: AbortCode | None
) -> None:
    asked = []

    def watch() -> coe_client.Conversation[bytes]:
        talk = coe_client.upload(0x1018, 1)
        ask = next(talk)
        while True:
            asked.append(ask)
            ask = talk.send((yield ask))

    with pytest.raises(MailboxProtocolError, match=reason):
        talk_to(COE, watch(), *answers)
    if abort is None:
        assert all(ask.expects_reply for ask in asked)
    else:
        assert asked[-1].request == bytes.fromhex("0020 80 1810 01") + abort.to_bytes(4, "little")
        assert not asked[-1].expects_reply


def test_upload_endless_short_segments_end_with_the_limit() -> None:
    answers = (f"0030 {(n % 2) << 4 | 0x0A:02x} 01020000000000" for n in itertools.count())
    first = "0030 41 1810 01 00000001 01"
    with pytest.raises(MailboxProtocolError, match="1001 short segments"):
        talk_to(
            COE,
            coe_client.upload(0x1018, 1, max_size=1 << 30),
            first,
            *itertools.islice(answers, 1100),
        )


def test_upload_without_answer_times_out() -> None:
    with pytest.raises(MailboxTimeoutError):
        talk_to(COE, coe_client.upload(0x1018, 1))


@pytest.mark.parametrize(
    ("data", "complete", "sent"),
    [
        (b"\1\2", False, ["2b 1810 01 01020000"]),
        (b"\1\2\3\4", True, ["33 1810 01 01020304"]),
        (b"", False, ["21 1810 01 00000000"]),
        (bytes(range(16)), False, ["21 1810 01 10000000 000102030405060708090a0b0c0d0e0f"]),
        (
            bytes(range(18)),
            True,
            ["31 1810 01 12000000 000102030405060708090a0b0c0d0e0f", "0b 1011 0000000000"],
        ),
        (
            bytes(range(40)),
            False,
            [
                "21 1810 01 28000000 000102030405060708090a0b0c0d0e0f",
                "00 101112131415161718191a1b1c1d1e1f20212223242526",
                "1d 27 000000000000",
            ],
        ),
    ],
)
def test_coe_client_downloads_in_segments(data: bytes, complete: bool, sent: list[str]) -> None:
    answers = ["0030 60 1810 01 00000000", "0030 20 00000000000000", "0030 30 00000000000000"]
    progress = Progress()
    talk = coe_client.download(0x1018, 1, data, SIZES, complete=complete, progress=progress)
    _, asked = run_with(COE, talk, answers[: len(sent)])
    assert asked == [bytes.fromhex("0020" + octets) for octets in sent]
    assert (progress.done, progress.total) == (len(data), len(data))


def test_echo_of_the_data_is_a_confirmation_too() -> None:
    answer = "0030 60 131c 01 001a0000"
    talk_to(COE, coe_client.download(0x1C13, 1, b"\x00\x1a", SIZES), answer)


def test_download_refused_segment() -> None:
    answers = ["0030 60 1810 01 00000000", "0020 80 1810 01 12000706"]
    with pytest.raises(SdoAbortError, match="longer than the entry"):
        talk_to(COE, coe_client.download(0x1018, 1, bytes(40), SIZES), *answers)


@given(st.lists(st.binary(max_size=24), max_size=30), st.booleans())
def test_coe_client_any_answers_end_in_data_or_an_error(
    noise: list[bytes], is_upload: bool
) -> None:
    answers = [b"\0\x30" + octets for octets in noise]
    talk = (
        coe_client.upload(0x1018, 1)
        if is_upload
        else coe_client.download(0x1018, 1, bytes(60), SIZES)
    )
    with suppress(BusError, SdoAbortError):
        talk_to(COE, talk, *answers)


def test_endless_segments_end_with_the_announced_size() -> None:
    answers = itertools.chain(
        ["0030 41 1810 01 40000000"],
        itertools.cycle(["0030 0c 01000000000000", "0030 1c 01000000000000"]),
    )
    read, asked = run_with(COE, coe_client.upload(0x1018, 1), answers)
    assert read == b"\1" * 64
    assert len(asked) == 65


def serve(sizes: MailboxSizes, line_faults: Random | None = None) -> tuple[Line, ObjectDictionary]:
    entries = {0: Entry("Count", "USINT", RW, 0)}
    entries |= {sub: Entry(f"PDO {sub}", "UINT", RW) for sub in range(1, 9)}
    dictionary = ObjectDictionary(
        [
            variable(0x2000, "Text", "STRING(3000)", RW, ""),
            variable(0x2001, "Number", "UDINT", RW),
            array(0x3000, "Array", "UDINT", [0] * 40, RW),
            OdObject(0x1C12, "Assignment", ObjectCode.ARRAY, entries),
        ]
    )
    server = CoeServer(dictionary, lambda: OdState.PREOP, sizes)
    return open_line(COE, server, sizes, faults(line_faults)), dictionary


def faults(dice: Random | None) -> object:
    if dice is None:
        return lambda: Fault.NONE
    return lambda: dice.choice([Fault.NONE] * 6 + list(Fault))


@examples(60)
@given(
    st.binary(max_size=1500).map(lambda data: data.replace(b"\0", b"x")),
    st.integers(16, 256),
    st.integers(16, 256),
    st.integers(0, 1 << 30),
)
def test_coe_client_reads_written_data_over_a_bad_line(
    data: bytes, to_slave: int, to_master: int, seed: int
) -> None:
    sizes = MailboxSizes(to_slave, to_master)
    line, _ = serve(sizes, Random(seed))
    line.run(coe_client.download(0x2000, 0, data, sizes))
    assert line.run(coe_client.upload(0x2000, 0)) == data


@examples(40)
@given(st.lists(st.integers(0, 0xFFFF), max_size=8), st.integers(16, 64), st.integers(0, 1 << 30))
def test_coe_complete_access_over_a_bad_line(numbers: list[int], size: int, seed: int) -> None:
    sizes = MailboxSizes(size, size)
    line, dictionary = serve(sizes, Random(seed))
    octets = b"".join(number.to_bytes(2, "little") for number in numbers)
    octets = bytes((len(numbers), 0)) + octets
    line.run(coe_client.download(0x1C12, 0, octets, sizes, complete=True))
    assert line.run(coe_client.upload(0x1C12, 0, complete=True)) == octets
    assert dictionary[0x1C12].max_subindex == len(numbers)


def test_bad_line_loses_and_repeats_messages() -> None:
    sizes = MailboxSizes(32, 32)
    line, _ = serve(sizes, Random(1))
    line.run(coe_client.download(0x2000, 0, b"x" * 1500, sizes))
    stats = line.server.stats()
    assert min(stats.repeated_requests, stats.repeated_replies) > 5
    assert stats.gaps == 0


class CoeMachine(RuleBasedStateMachine):
    """Transfers that end, are refused or cancelled, in any order, over a bad line."""

    def __init__(self) -> None:
        super().__init__()
        self.sizes = MailboxSizes(40, 36)
        self.line, _ = serve(self.sizes, Random(5))
        self.text = b""
        self.numbers = [0] * 41

    @rule(data=st.binary(max_size=200).map(lambda data: data.replace(b"\0", b"x")))
    def write_text(self, data: bytes) -> None:
        self.line.run(coe_client.download(0x2000, 0, data, self.sizes))
        self.text = data

    @rule()
    def read_text(self) -> None:
        assert self.line.run(coe_client.upload(0x2000, 0)) == self.text

    @rule(subindex=st.integers(1, 40), number=st.integers(0, 0xFFFFFFFF))
    def write_number(self, subindex: int, number: int) -> None:
        data = number.to_bytes(4, "little")
        self.line.run(coe_client.download(0x3000, subindex, data, self.sizes))
        self.numbers[subindex] = number

    @rule(subindex=st.integers(1, 40))
    def read_number(self, subindex: int) -> None:
        read = self.line.run(coe_client.upload(0x3000, subindex))
        assert int.from_bytes(read, "little") == self.numbers[subindex]

    @rule()
    def read_all(self) -> None:
        read = self.line.run(coe_client.upload(0x3000, 1, complete=True))
        assert read == b"".join(number.to_bytes(4, "little") for number in self.numbers[1:])

    @rule(subindex=st.integers(41, 255))
    def refused(self, subindex: int) -> None:
        with pytest.raises(SdoAbortError, match="subindex does not exist"):
            self.line.run(coe_client.upload(0x3000, subindex))

    @rule(steps=st.integers(0, 6), is_upload=st.booleans())
    def cancelled(self, steps: int, is_upload: bool) -> None:
        if is_upload:
            self.line.run_partly(coe_client.upload(0x3000, 1, complete=True), steps)
        else:
            too_long = coe_client.download(0x2000, 0, self.text + b"y" * 300, self.sizes)
            self.line.run_partly(too_long, steps)


TestCoeMachine = CoeMachine.TestCase
TestCoeMachine.settings = examples(25, stateful_step_count=25)


PDOS = {CoeService.TX_PDO: b"inputs", CoeService.RX_PDO: b"outputs"}


def serve_info(size: int = 128, seed: int | None = None) -> Line:
    level = Entry("Level", "INT", RO | Access.TX_MAPPABLE, 5, maximum=9, unit=7)
    dictionary = ObjectDictionary(
        [
            record(0x6000, "Inputs", {1: level}),
            *(variable(0x2000 + n, f"Value {n}", "UINT") for n in range(100)),
        ]
    )
    sizes = MailboxSizes(size, size)
    server = CoeServer(
        dictionary,
        lambda: OdState.PREOP,
        sizes,
        read_pdo=lambda service, number: PDOS[service] if number == 1 else None,
        write_pdo=lambda number, data: (number, data) == (3, b"new"),
    )
    dice = Random(seed)
    bad = [Fault.NONE] * 6 + list(Fault)
    return open_line(COE, server, sizes, lambda: dice.choice(bad) if seed else Fault.NONE)


@pytest.mark.parametrize("size", [16, 40, 256])
@pytest.mark.parametrize("seed", [None, 3])
def test_coe_client_reads_lists_in_fragments(size: int, seed: int | None) -> None:
    line = serve_info(size, seed)
    assert line.run(coe_client.object_list()) == [*range(0x2000, 0x2064), 0x6000]
    assert line.run(coe_client.object_list(ListType.TX_MAPPABLE)) == [0x6000]
    assert line.run(coe_client.object_list(ListType.RX_MAPPABLE)) == []
    assert line.run(coe_client.object_list(ListType.COUNTS)) == [101, 0, 1, 0, 0]


@pytest.mark.parametrize("size", [16, 128])
def test_coe_client_reads_descriptions(size: int) -> None:
    line = serve_info(size)
    described = line.run(coe_client.object_description(0x6000))
    assert described == ObjectDescription(0x6000, 3, 1, 9, "Inputs")
    entry = line.run(coe_client.entry_description(0x6000, 1))
    assert entry == EntryDescription(0x6000, 1, 3, 16, 0x87, "Level", 7, b"\5\0", None, b"\x09\0")


def test_coe_client_refusal_is_raised() -> None:
    line = serve_info()
    with pytest.raises(SdoAbortError, match="0x3000:00: object does not exist"):
        line.run(coe_client.object_description(0x3000))
    with pytest.raises(SdoAbortError, match="0x6000:09: subindex does not exist"):
        line.run(coe_client.entry_description(0x6000, 9))


def test_coe_client_requests_as_the_vector() -> None:
    answer = "0080 02 00 0000 0100 0010"
    listed, asked = run_with(COE, coe_client.object_list(), [answer])
    assert (listed, asked) == ([0x1000], [bytes.fromhex("0080 01 00 0000 0100")])
    answer = "0080 06 00 0000 1810 01 00 0700 2000 0700"
    _, asked = run_with(COE, coe_client.entry_description(0x1018, 1), [answer])
    assert asked == [bytes.fromhex("0080 05 00 0000 1810 01 7f")]


def test_late_and_repeated_fragments_are_not_taken() -> None:
    answers = [
        "0030 43 1810 01 02000000",
        "0080 02 00 0000 0200 99 99",
        "0080 04 00 0000 0100 0700 00 07",
        "0080 82 00 0200 0100 0010",
        "0080 82 00 0200 0100 0010",
        "0080 82 00 0100 0110",
        "0080 82 00 0100 0110",
        "0080 02 00 0000 0210",
    ]
    assert talk_to(COE, coe_client.object_list(), *answers) == [0x1000, 0x1001, 0x1002]


def test_incomplete_bit_alone_does_not_count() -> None:
    answers = ["0080 02 00 0100 0100 0010", "0080 82 00 0000 0110"]
    assert talk_to(COE, coe_client.object_list(), *answers) == [0x1000, 0x1001]


@pytest.mark.parametrize(
    ("answers", "reason"),
    [
        (["0080 02 00 0000 0100 00"], "3 bytes, expected whole indexes"),
        (["0080 02"], "needs 4 bytes"),
        (["0080 07 00 0000 0100"], "needs 4 bytes"),
        (["0080 82 00 0500 0100 0010", "0080 82 00 0300 0110"], "5 fragments left, then 3"),
        (
            [
                f"0080 82 00 {left & 255:02x}{left >> 8:02x} 0100 {'00' * 1000}"
                for left in range(0xFFFF, 0xFF00, -1)
            ],
            "more than 131074 bytes",
        ),
    ],
)
def test_info_answer_that_breaks_the_protocol(answers: list[str], reason: str) -> None:
    with pytest.raises(MailboxProtocolError, match=reason):
        talk_to(COE, coe_client.object_list(), *answers)


def test_description_that_is_cut_breaks_the_protocol() -> None:
    answer = "0080 06 00 0000 1810 01 08 0700 2000 0700"
    with pytest.raises(MailboxProtocolError, match="entry description 0x1018:01"):
        talk_to(COE, coe_client.entry_description(0x1018, 1), answer)


@given(st.lists(st.binary(max_size=16), max_size=10))
def test_coe_client_any_answers_end_in_a_description_or_an_error(noise: list[bytes]) -> None:
    answers = [b"\0\x80" + octets for octets in noise]
    with suppress(BusError, SdoAbortError):
        talk_to(COE, coe_client.object_description(0x1018), *answers)


def test_pdos_go_through_the_mailbox() -> None:
    line = serve_info()
    assert line.run(coe_client.read_pdo(CoeService.TX_PDO, 1)) == b"inputs"
    assert line.run(coe_client.read_pdo(CoeService.RX_PDO, 1)) == b"outputs"
    line.run(coe_client.write_rx_pdo(3, b"new"))
    assert line.fetch() == []
    with pytest.raises(MailboxRefusedError):
        line.run(coe_client.read_pdo(CoeService.TX_PDO, 2))


def test_other_pdo_is_not_taken() -> None:
    answers = ["0240 ff", "0150 ff", "0140 07"]
    assert talk_to(COE, coe_client.read_pdo(CoeService.TX_PDO, 1), *answers) == b"\7"
