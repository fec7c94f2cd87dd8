from __future__ import annotations

import pytest

from devicebus.errors import FoeError
from devicebus.mailbox.foe_store import AllowedIn, MemoryFile, MemoryStore, refusal
from eap.codec.foe import FoeErrorCode


def wrong_checksum(content: bytes) -> None:
    if sum(content) % 256:
        raise refusal(FoeErrorCode.CHECKSUM, "sum is not 0")


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


def test_reader_keeps_the_content_it_was_opened_with() -> None:
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


def test_content_that_grows_too_large_is_refused() -> None:
    writer = make().open_write("plain", 0)
    writer.write(b"0123456789")
    writer.write(b"ab")
    assert code_of(writer.write, b"c") is FoeErrorCode.DISK_FULL


def test_content_that_fails_its_check_is_not_taken() -> None:
    store = make()
    writer = store.open_write("checked", 0)
    writer.write(b"\x01\xfe")
    assert code_of(writer.commit) is FoeErrorCode.CHECKSUM
    assert store.files["checked"].content == b""
    writer.write(b"\x01")
    writer.commit()
    assert store.files["checked"].content == b"\x01\xfe\x01"


def test_new_file_appears_when_it_is_complete() -> None:
    store = make(creates=True)
    writer = store.open_write("new", 0)
    writer.write(b"abc")
    assert "new" not in store.files
    writer.commit()
    assert store.open_read("new", 0).read(9) == b"abc"
    assert code_of(store.open_write, "", 0) is FoeErrorCode.NOT_FOUND


def test_existing_file_may_be_kept() -> None:
    assert code_of(make(overwrites=False).open_write, "plain", 0) is FoeErrorCode.ALREADY_EXISTS


def test_refusal_says_what_and_why() -> None:
    error = refusal(FoeErrorCode.DISK_FULL, "log.txt")
    assert (str(error), error.code, error.text) == (error.text, 0x8003, "log.txt: disk full")
