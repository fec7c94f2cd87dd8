"""Requests and answers byte for byte; mailboxes have room for 4 bytes of a file."""

from __future__ import annotations

import io

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.errors import FoeError, MailboxRefusedError
from devicebus.mailbox.foe_server import (
    AllowedIn,
    FileReader,
    FoeServer,
    MemoryFile,
    MemoryStore,
    store_error,
)
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.foe import FoeErrorCode
from eap.codec.mailbox import MailboxError


class Slave:
    def __init__(self, content: bytes = b"", *, packet_time_ns: int = 0) -> None:
        self.file = MemoryFile("f", content, max_size=9)
        store = MemoryStore([self.file, MemoryFile("secret", password=0x12345678)])
        self.server = FoeServer(store, MailboxSizes(16, 16), packet_time_ns=packet_time_ns)

    def ask(self, octets: str, now_ns: int = 0) -> str:
        answers = self.server.receive_message(bytes.fromhex(octets), now_ns)
        return " | ".join(answer.hex(" ") for answer in answers)

    def error(self, octets: str) -> FoeErrorCode:
        answer = bytes.fromhex(self.ask(octets))
        assert answer[:2] == b"\x05\x00"
        return FoeErrorCode(int.from_bytes(answer[2:6], "little"))


READ = "01 00 00000000 66"
WRITE = "02 00 00000000 66"


def test_read_of_several_packets() -> None:
    slave = Slave(b"abcdefg")
    assert slave.ask(READ) == "03 00 01 00 00 00 61 62 63 64"
    assert slave.ask("04 00 01000000") == "03 00 02 00 00 00 65 66 67"
    assert slave.ask("04 00 02000000") == ""
    assert slave.error("04 00 02000000") is FoeErrorCode.ILLEGAL


@pytest.mark.parametrize("content", [b"", b"abcd"])
def test_foe_server_file_of_full_packets_ends_with_an_empty_one(content: bytes) -> None:
    slave = Slave(content)
    answer = slave.ask(READ)
    if content:
        assert answer == "03 00 01 00 00 00 61 62 63 64"
        assert slave.ask("04 00 01000000") == "03 00 02 00 00 00"
    else:
        assert answer == "03 00 01 00 00 00"


def test_foe_server_repeats_the_packet_for_a_busy_client() -> None:
    slave = Slave(b"abcdefg")
    assert slave.ask(READ) == slave.ask("06 00 00000000")


def test_write_of_several_packets() -> None:
    slave = Slave(b"old")
    assert slave.ask(WRITE) == "04 00 00 00 00 00"
    assert slave.ask("03 00 01000000 61626364") == "04 00 01 00 00 00"
    assert slave.file.content == b"old"
    assert slave.ask("03 00 02000000 6566") == "04 00 02 00 00 00"
    assert slave.file.content == b"abcdef"
    assert slave.error("03 00 03000000") is FoeErrorCode.ILLEGAL


def test_foe_server_write_of_full_packets_ends_with_an_empty_one() -> None:
    slave = Slave()
    slave.ask(WRITE)
    slave.ask("03 00 01000000 61626364")
    assert slave.ask("03 00 02000000") == "04 00 02 00 00 00"
    assert slave.file.content == b"abcd"


def test_foe_server_is_busy_while_it_stores() -> None:
    slave = Slave(packet_time_ns=1000)
    slave.ask(WRITE, 0)
    assert slave.ask("03 00 01000000 61626364", 0) == "04 00 01 00 00 00"
    assert slave.ask("03 00 02000000 65", 250) == "06 00 19 00 64 00"
    assert slave.ask("03 00 02000000 65", 999) == "06 00 63 00 64 00"
    assert slave.file.content == b""
    assert slave.ask("03 00 02000000 65", 1000) == "04 00 02 00 00 00"
    assert slave.file.content == b"abcde"
    assert slave.ask(WRITE, 1001) == "04 00 00 00 00 00"
    assert slave.ask("03 00 01000000 61", 1001) == "04 00 01 00 00 00"


@pytest.mark.parametrize("number", ["00000000", "02000000", "ffffffff"])
def test_wrong_packet_number_ends_a_write(number: str) -> None:
    slave = Slave(b"old")
    slave.ask(WRITE)
    assert slave.error(f"03 00 {number} 61") is FoeErrorCode.PACKET_NUMBER
    assert slave.error("03 00 01000000 61") is FoeErrorCode.ILLEGAL
    assert slave.file.content == b"old"


def test_wrong_packet_number_ends_a_read_and_is_explained() -> None:
    slave = Slave(b"abcdefg")
    slave.ask(READ)
    answer = bytes.fromhex(slave.ask("04 00 02000000"))
    assert answer == bytes.fromhex("05 00 05800000") + b"pack"
    assert slave.error("04 00 01000000") is FoeErrorCode.ILLEGAL


@pytest.mark.parametrize(
    "octets",
    ["03 00 01000000", "04 00 00000000", "06 00 00000000", "00 00 00000000", "07 00 00000000"],
)
def test_message_without_a_transfer_is_illegal(octets: str) -> None:
    assert Slave().error(octets) is FoeErrorCode.ILLEGAL


def test_foe_server_refuses_wrong_password() -> None:
    assert Slave().error("01 00 00000000 736563726574") is FoeErrorCode.NO_RIGHTS
    assert Slave().ask("01 00 78563412 736563726574 00") == "03 00 01 00 00 00"


def test_foe_server_store_error_is_sent_with_its_text() -> None:
    answer = Slave().ask("02 00 00000000 6e6f746865726521")
    assert bytes.fromhex(answer) == bytes.fromhex("05 00 01800000") + b"noth"


def test_foe_server_store_error_ends_the_write() -> None:
    slave = Slave(b"old")
    slave.ask(WRITE)
    slave.ask("03 00 01000000 61626364")
    slave.ask("03 00 02000000 61626364")
    assert slave.error("03 00 03000000 61626364") is FoeErrorCode.DISK_FULL
    assert slave.error("03 00 03000000 61") is FoeErrorCode.ILLEGAL
    assert slave.file.content == b"old"


def test_foe_server_error_of_the_client_ends_the_transfer() -> None:
    slave = Slave(b"abcdefg")
    slave.ask(READ)
    assert slave.ask("05 00 03800000") == ""
    assert slave.error("04 00 01000000") is FoeErrorCode.ILLEGAL


def test_new_request_and_reset_end_the_transfer_before() -> None:
    slave = Slave(b"old")
    slave.ask(WRITE)
    slave.ask("03 00 01000000 61626364")
    assert slave.ask(READ) == "03 00 01 00 00 00 6f 6c 64"
    slave.server.reset()
    assert slave.error("04 00 01000000") is FoeErrorCode.ILLEGAL
    assert slave.server.messages_to_send(0) == []


def test_message_without_a_header_is_too_short() -> None:
    with pytest.raises(MailboxRefusedError) as caught:
        Slave().ask("01 00 000000")
    assert caught.value.detail == MailboxError.SIZE_TOO_SHORT


def test_foe_server_reads_any_file_object() -> None:
    class Folder:
        opened = io.BytesIO(b"abcdefg")

        def open_read(self, name: str, password: int) -> FileReader:
            return self.opened

        def open_write(self, name: str, password: int) -> object:
            raise FoeError(name, code=FoeErrorCode.ACCESS_DENIED)

    server = FoeServer(Folder(), MailboxSizes(16, 16))
    assert server.receive_message(bytes.fromhex(READ), 0) == [b"\x03\0\1\0\0\0abcd"]
    assert server.receive_message(bytes.fromhex(WRITE), 0) == [bytes.fromhex("05 00 02800000")]
    assert Folder.opened.closed


@given(st.lists(st.binary(min_size=6, max_size=12), max_size=20))
def test_foe_server_any_request_has_one_answer_at_most(requests: list[bytes]) -> None:
    slave = Slave(b"abcdefg")
    for request in requests:
        answers = slave.server.receive_message(request, 0)
        assert len(answers) <= 1
        assert all(len(answer) <= 10 for answer in answers)


@pytest.mark.parametrize("code", FoeErrorCode)
@pytest.mark.parametrize("request_", [READ, WRITE])
def test_foe_server_forced_error_refuses_every_request(code, request_) -> None:
    slave = Slave(b"ab")
    slave.server.forced_error = code
    assert slave.error(request_) is code
    assert len(bytes.fromhex(slave.ask(request_))) > 6
    slave.server.forced_error = 0
    assert slave.ask(READ) == "03 00 01 00 00 00 61 62"
    slave.server.forced_error = code
    assert slave.ask("04 00 01000000") == ""


def wrong_checksum(content: bytes) -> None:
    if sum(content) % 256:
        raise store_error(FoeErrorCode.CHECKSUM, "sum is not 0")


def make(*, is_boot: bool = False, creates: bool = False, overwrites: bool = True) -> MemoryStore:
    return MemoryStore(
        [
            MemoryFile("plain", b"0123456789", max_size=12),
            MemoryFile("secret", b"x", password=7),
            MemoryFile("log", b"x", writable=False),
            MemoryFile("update", b"x", readable=False),
            MemoryFile("firmware", b"x", allowed_in=AllowedIn.BOOT),
            MemoryFile("recipe", b"x", allowed_in=AllowedIn.OTHERS),
            MemoryFile("checked", b"", check=wrong_checksum),
        ],
        is_boot=lambda: is_boot,
        creates=creates,
        overwrites=overwrites,
    )


def code_of(call: object, *arguments: object) -> FoeErrorCode:
    with pytest.raises(FoeError) as caught:
        call(*arguments)  # type: ignore[operator]
    return FoeErrorCode(caught.value.code)


def test_file_is_read_piece_by_piece() -> None:
    reader = make().open_read("plain", 0)
    assert [reader.read(4) for _ in range(4)] == [b"0123", b"4567", b"89", b""]
    reader = make().open_read("plain", 0)
    reader.close()
    assert reader.read(4) == b""


def test_memory_reader_keeps_the_content_of_its_opening() -> None:
    store = make()
    reader = store.open_read("plain", 0)
    writer = store.open_write("plain", 0)
    writer.write(b"new")
    writer.commit()
    assert reader.read(99) == b"0123456789"
    assert store.files["plain"].content == b"new"


def test_discarded_content_is_never_seen() -> None:
    store = make()
    writer = store.open_write("plain", 0)
    writer.write(b"new")
    writer.discard()
    assert store.files["plain"].content == b"0123456789"


@pytest.mark.parametrize(
    ("name", "password", "is_boot", "read", "write"),
    [
        ("missing", 0, False, "NOT_FOUND", "NOT_FOUND"),
        ("secret", 0, False, "NO_RIGHTS", "NO_RIGHTS"),
        ("plain", 1, False, "NO_RIGHTS", "NO_RIGHTS"),
        ("log", 0, False, None, "ACCESS_DENIED"),
        ("update", 0, False, "ACCESS_DENIED", None),
        ("firmware", 0, False, "BOOTSTRAP_ONLY", "BOOTSTRAP_ONLY"),
        ("firmware", 0, True, None, None),
        ("recipe", 0, True, "NOT_IN_BOOTSTRAP", "NOT_IN_BOOTSTRAP"),
        ("recipe", 0, False, None, None),
        ("secret", 7, False, None, None),
    ],
)
def test_rules_of_a_file(
    name: str, password: int, is_boot: bool, read: str | None, write: str | None
) -> None:
    store = make(is_boot=is_boot)
    for call, code in ((store.open_read, read), (store.open_write, write)):
        if code is None:
            assert call(name, password)
        else:
            assert code_of(call, name, password).name == code


def test_memory_store_refuses_too_large_content() -> None:
    writer = make().open_write("plain", 0)
    writer.write(b"0123456789")
    writer.write(b"ab")
    assert code_of(writer.write, b"c") is FoeErrorCode.DISK_FULL


def test_memory_store_check_refuses_content() -> None:
    store = make()
    writer = store.open_write("checked", 0)
    writer.write(b"\x01\xfe")
    assert code_of(writer.commit) is FoeErrorCode.CHECKSUM
    assert store.files["checked"].content == b""
    writer.write(b"\x01")
    writer.commit()
    assert store.files["checked"].content == b"\x01\xfe\x01"


def test_memory_store_new_file_appears_when_complete() -> None:
    store = make(creates=True)
    writer = store.open_write("new", 0)
    writer.write(b"abc")
    assert "new" not in store.files
    writer.commit()
    assert store.open_read("new", 0).read(9) == b"abc"
    assert code_of(store.open_write, "", 0) is FoeErrorCode.NOT_FOUND


def test_memory_store_refuses_to_overwrite() -> None:
    assert code_of(make(overwrites=False).open_write, "plain", 0) is FoeErrorCode.ALREADY_EXISTS


def test_store_error_has_file_and_reason() -> None:
    error = store_error(FoeErrorCode.DISK_FULL, "log.txt")
    assert (str(error), error.code, error.text) == (error.text, 0x8003, "log.txt: disk full")
