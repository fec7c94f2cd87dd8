"""Conversations byte for byte, with slaves that do not behave, and with ours on a bad line."""

from __future__ import annotations

import io
import itertools
from contextlib import suppress
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule

from devicebus.errors import (
    BusError,
    FoeError,
    MailboxProtocolError,
    MailboxSizeError,
    MailboxTimeoutError,
)
from devicebus.mailbox import foe_client
from devicebus.mailbox.conversation import MailboxMessage, Progress
from devicebus.mailbox.foe_server import FoeServer, MemoryFile, MemoryStore
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.foe import FoeErrorCode
from eap.codec.mailbox import MailboxType
from tests.support.examples import examples
from tests.support.mailbox import Fault, Line, open_line, run_with

FOE = MailboxType.FOE
SIZES = MailboxSizes(16, 16)
NAME = "f"
BUSY = "06 00 0a006400"


def read(answers: object, **options: object) -> tuple[bytes, list[str]]:
    sink = io.BytesIO()
    talk = foe_client.read(NAME, sink.write, SIZES, **options)
    size, asked = run_with(FOE, talk, answers)
    assert size == len(sink.getvalue())
    return sink.getvalue(), [data.hex(" ") for data in asked]


def write(data: bytes, answers: object, **options: object) -> list[str]:
    source = io.BytesIO(data)
    size, asked = run_with(FOE, foe_client.write(NAME, source.read, SIZES, **options), answers)
    assert size == len(data)
    return [octets.hex(" ") for octets in asked]


def test_read_of_several_packets() -> None:
    progress = Progress()
    content, asked = read(
        ["03 00 01000000 61626364", "03 00 02000000 6566"], password=0x12345678, progress=progress
    )
    assert content == b"abcdef"
    assert asked == ["01 00 78 56 34 12 66", "04 00 01 00 00 00", "04 00 02 00 00 00"]
    assert (progress.done, progress.total) == (6, None)


def test_read_ends_with_an_empty_packet() -> None:
    assert read(["03 00 01000000 61626364", "03 00 02000000"])[0] == b"abcd"
    assert read(["03 00 01000000"])[0] == b""


@pytest.mark.parametrize(
    ("data", "packets"),
    [
        (b"", ["03 00 01 00 00 00"]),
        (b"abc", ["03 00 01 00 00 00 61 62 63"]),
        (b"abcd", ["03 00 01 00 00 00 61 62 63 64", "03 00 02 00 00 00"]),
        (b"abcdef", ["03 00 01 00 00 00 61 62 63 64", "03 00 02 00 00 00 65 66"]),
    ],
)
def test_foe_client_writes_in_packets(data: bytes, packets: list[str]) -> None:
    progress = Progress(len(data))
    answers = [f"04 00 0{number}000000" for number in range(len(packets) + 1)]
    assert write(data, answers, progress=progress) == ["02 00 00 00 00 00 66", *packets]
    assert progress.done == len(data)


def test_foe_write_source_may_return_less_than_requested() -> None:
    pieces = iter([b"a", b"bc", b"d", b"ef", b""])
    talk = foe_client.write(NAME, lambda size: next(pieces), SIZES)
    answers = ["04 00 00000000", "04 00 01000000", "04 00 02000000"]
    size, asked = run_with(FOE, talk, answers)
    assert size == 6
    assert [data[6:] for data in asked[1:]] == [b"abcd", b"ef"]


def test_foe_busy_answer_repeats_the_request_after_a_pause() -> None:
    asked = write(b"ab", [BUSY, "04 00 00000000", BUSY, BUSY, "04 00 01000000"])
    assert asked == ["02 00 00 00 00 00 66"] * 2 + ["03 00 01 00 00 00 61 62"] * 3
    talk = foe_client.write(NAME, io.BytesIO(b"ab").read, SIZES)
    assert next(talk).delay_ns == 0
    busy = MailboxMessage(FOE, bytes.fromhex(BUSY))
    assert talk.send(busy).delay_ns == foe_client.BUSY_DELAY_NS


def test_endless_busy_ends_in_a_timeout() -> None:
    with pytest.raises(MailboxTimeoutError, match="FoE write of 'f': still busy after 6000"):
        write(b"ab", itertools.repeat(BUSY))
    with pytest.raises(MailboxTimeoutError, match="FoE read of 'f': still busy"):
        read(itertools.repeat(BUSY))


def test_foe_slow_busy_answers_time_out() -> None:
    talk = foe_client.write(NAME, io.BytesIO(b"ab").read, SIZES)
    next(talk)
    slow = (MailboxMessage(FOE, bytes.fromhex(BUSY), n * 2_900_000_000) for n in itertools.count())
    with pytest.raises(MailboxTimeoutError, match="still busy after 43 answers"):
        list(map(talk.send, slow))


def test_late_messages_are_not_taken() -> None:
    content, _ = read(
        [
            "04 00 01000000",
            "03 00 05000000 78",
            "03 00 01000000 61626364",
            "03 00 01000000 61626364",
            "03 00 02000000 65",
        ]
    )
    assert content == b"abcde"
    asked = write(
        b"abcdef",
        ["04 00 07000000", "03 00 01000000", "04 00 00000000", "04 00 00000000", "04 00 01000000",
         "04 00 01000000", "04 00 02000000"],
    )  # fmt: skip
    assert len(asked) == 3


def test_foe_error_is_raised_with_code_and_text() -> None:
    answer = "05 00 02800000" + b"locked\0".hex()
    with pytest.raises(
        FoeError, match=r"read of 'f': access denied \(0x8002\).*'locked'"
    ) as caught:
        read([answer])
    assert (caught.value.code, caught.value.text) == (FoeErrorCode.ACCESS_DENIED, "locked")
    with pytest.raises(FoeError, match=r"write of 'f': disk full \(0x8003\)$"):
        write(b"abcdef", ["04 00 00000000", "05 00 03800000"])


@pytest.mark.parametrize(
    ("answers", "reason"),
    [
        (["03 00 0100"], "needs 6 bytes"),
        (["03 00 00000000 61"], "packet 0, expected 1"),
        (["03 00 01000000 61626364", "03 00 03000000 61"], "packet 3, expected 2"),
        (["03 00 01000000 6162636465"], "5 bytes, at most"),
    ],
)
def test_read_that_breaks_the_protocol(answers: list[str], reason: str) -> None:
    with pytest.raises(MailboxProtocolError, match=reason):
        read(answers)


def test_foe_read_endless_file_ends_with_the_limit() -> None:
    packets = (f"03 00 {n.to_bytes(4, 'little').hex()} 61626364" for n in itertools.count(1))
    with pytest.raises(MailboxProtocolError, match="4 bytes, at most"):
        read(packets, max_size=402)


@pytest.mark.parametrize(
    ("answers", "reason"),
    [
        (["04"], "needs 6 bytes"),
        (["04 00 00000000", "04 00 05000000"], "packet 5 acknowledged, expected 1"),
        (
            ["04 00 00000000", "04 00 01000000", "04 00 05000000"],
            "packet 5 acknowledged, expected 2",
        ),
    ],
)
def test_write_that_breaks_the_protocol(answers: list[str], reason: str) -> None:
    with pytest.raises(MailboxProtocolError, match=reason):
        write(b"abcdef", answers)


def test_foe_name_longer_than_the_mailbox_is_refused() -> None:
    with pytest.raises(MailboxSizeError, match="'abcde' has 5 bytes, the mailbox holds 4"):
        next(foe_client.read("abcde", bytearray().extend, SIZES))


def broken(_: object) -> bytes:
    raise OSError("disk on fire")


def test_foe_local_error_is_sent_to_the_slave() -> None:
    for talk, answers, code in (
        (foe_client.read(NAME, broken, SIZES), ["03 00 01000000 61"], "03800000"),
        (foe_client.write(NAME, broken, SIZES), ["04 00 00000000"], "00800000"),
    ):
        asked: list[bytes] = []

        def watch(talk: foe_client.Conversation[int] = talk, asked: list = asked) -> object:
            ask = next(talk)
            while True:
                asked.append(ask.request)
                ask = talk.send((yield ask))

        with pytest.raises(OSError, match="disk on fire"):
            run_with(FOE, watch(), answers)
        assert asked[-1] == bytes.fromhex(f"05 00 {code}")


@given(st.lists(st.binary(max_size=14), max_size=20), st.booleans())
def test_foe_any_answers_end_in_a_file_or_an_error(noise: list[bytes], is_read: bool) -> None:
    with suppress(BusError):
        if is_read:
            read(noise)
        else:
            write(b"abcdefgh", noise)


def serve(sizes: MailboxSizes, dice: Random | None, packet_time_ns: int = 0) -> Line:
    store = MemoryStore([MemoryFile("a"), MemoryFile("b", password=5)], creates=True)
    server = FoeServer(store, sizes, packet_time_ns=packet_time_ns)
    bad = [Fault.NONE] * 6 + list(Fault)
    return open_line(FOE, server, sizes, lambda: dice.choice(bad) if dice else Fault.NONE)


def put(line: Line, name: str, data: bytes, password: int = 0) -> None:
    source = io.BytesIO(data)
    line.run(foe_client.write(name, source.read, line.server.sizes, password=password))


def get(line: Line, name: str, password: int = 0) -> bytes:
    sink = io.BytesIO()
    line.run(foe_client.read(name, sink.write, line.server.sizes, password=password))
    return sink.getvalue()


@examples(60)
@given(
    st.binary(max_size=600),
    st.integers(16, 128),
    st.integers(16, 128),
    st.sampled_from([0, 25_000_000]),
    st.integers(0, 1 << 30),
)
def test_foe_client_reads_written_data_over_a_bad_line(
    data: bytes, to_slave: int, to_master: int, packet_time_ns: int, seed: int
) -> None:
    line = serve(MailboxSizes(to_slave, to_master), Random(seed), packet_time_ns)
    put(line, "a", data)
    assert get(line, "a") == data


def test_large_file_is_never_held_by_the_client() -> None:
    line = serve(MailboxSizes(1024, 1024), None)
    data = Random(1).randbytes(1 << 20)
    largest = 0

    def sink(piece: bytes) -> None:
        nonlocal largest
        largest = max(largest, len(piece))

    put(line, "a", data)
    assert get(line, "a") == data
    assert line.run(foe_client.read("a", sink, line.server.sizes)) == len(data)
    assert largest == 1012


class FoeMachine(RuleBasedStateMachine):
    """Files that are written, read, refused and given up, in any order, over a bad line."""

    def __init__(self) -> None:
        super().__init__()
        self.line = serve(MailboxSizes(24, 20), Random(7))
        self.files = {"a": b"", "b": b""}
        self.passwords = {"b": 5}

    @rule(name=st.sampled_from("abc"), data=st.binary(max_size=60))
    def write(self, name: str, data: bytes) -> None:
        put(self.line, name, data, self.passwords.get(name, 0))
        self.files[name] = data

    @rule(name=st.sampled_from("abcd"))
    def read(self, name: str) -> None:
        if name in self.files:
            assert get(self.line, name, self.passwords.get(name, 0)) == self.files[name]
        else:
            with pytest.raises(FoeError, match="file not found"):
                get(self.line, name)

    @rule()
    def wrong_password(self) -> None:
        with pytest.raises(FoeError, match="no rights"):
            put(self.line, "b", b"new", 6)

    @rule(name=st.sampled_from("ab"), steps=st.integers(0, 5), is_read=st.booleans())
    def cancelled(self, name: str, steps: int, is_read: bool) -> None:
        sizes = self.line.server.sizes
        password = self.passwords.get(name, 0)
        if is_read:
            talk = foe_client.read(name, bytearray().extend, sizes, password=password)
        else:
            source = io.BytesIO(bytes(100))
            talk = foe_client.write(name, source.read, sizes, password=password)
        self.line.run_partly(talk, steps)


TestFoeMachine = FoeMachine.TestCase
TestFoeMachine.settings = examples(25, stateful_step_count=25)
