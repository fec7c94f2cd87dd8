"""FoE of a slave: files read and written one message at a time (ETG.1000.6).

A :class:`FileStore` opens the files and refuses with FoeError; :class:`MemoryStore` is the store of
a simulated slave, with its own rules for each file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import Enum, auto
from typing import Protocol

from devicebus.errors import FoeError
from devicebus.mailbox.protocol import MailboxSizes, raise_mailbox_error
from eap.codec.foe import (
    DATA_OVERHEAD,
    Busy,
    FoeErrorCode,
    FoeHeader,
    FoeOpcode,
    encode_message,
    name_of,
    text_of,
)
from eap.codec.mailbox import MailboxError
from eap.errors import MalformedError, TruncatedError

_REQUESTS = frozenset((FoeOpcode.READ, FoeOpcode.WRITE))


class FileReader(Protocol):
    """File opened for reading; any binary file object is one."""

    def read(self, size: int, /) -> bytes:
        """Return the next *size* bytes, fewer only at the end."""

    def close(self) -> None:
        """Close the file."""


class FileWriter(Protocol):
    """File opened for writing; each method may raise FoeError."""

    def write(self, data: bytes, /) -> object:
        """Append *data*."""

    def commit(self) -> None:
        """Replace the file's content by the written data, which is complete."""

    def discard(self) -> None:
        """Discard the written data, which is incomplete."""


class FileStore(Protocol):
    """Store of a slave's files; each method may raise FoeError."""

    def open_read(self, name: str, password: int) -> FileReader:
        """Open a file for reading."""

    def open_write(self, name: str, password: int) -> FileWriter:
        """Open a file for writing from its start."""


class FoeServer:
    """FoE protocol of a slave; a new request ends the transfer before it.

    Args:
        store: Files of the slave.
        sizes: Sizes of the slave's mailboxes.

    Attributes:
        packet_time_ns: Time to store the data of one message; the server answers BUSY meanwhile.
        forced_error: Fault: error code that answers every request; 0 for none.
    """

    def __init__(self, store: FileStore, sizes: MailboxSizes, *, packet_time_ns: int = 0) -> None:
        self._store = store
        self._sizes = sizes
        self.packet_time_ns = packet_time_ns
        self.forced_error = 0
        self._reader: FileReader | None = None
        self._writer: FileWriter | None = None
        self._number = 0
        self._sent = b""
        self._is_last = False
        self._busy_from_ns = self._busy_until_ns = 0

    def reset(self) -> None:
        """Discard the transfer under way."""
        reader, self._reader = self._reader, None
        writer, self._writer = self._writer, None
        if reader is not None:
            reader.close()
        if writer is not None:
            writer.discard()

    def messages_to_send(self, now_ns: int) -> list[bytes]:
        """Return nothing: an FoE server only answers."""
        del now_ns
        return []

    def receive_message(self, data: bytes, now_ns: int) -> list[bytes]:
        """Handle a message (without mailbox header) and return its answers."""
        try:
            header = FoeHeader.decode(data)
            return self._answer(header, data[FoeHeader.SIZE :], now_ns)
        except TruncatedError as exc:
            raise_mailbox_error(MailboxError.SIZE_TOO_SHORT, str(exc))
        except MalformedError:
            self.reset()
            return [encode_message(FoeOpcode.ERROR, FoeErrorCode.ILLEGAL)]
        except FoeError as exc:
            self.reset()
            text = exc.text.encode()[: self._sizes.data_to_master - FoeHeader.SIZE]
            return [encode_message(FoeOpcode.ERROR, exc.code, text)]

    def _answer(self, header: FoeHeader, body: bytes, now_ns: int) -> list[bytes]:
        opcode = header.opcode
        if self.forced_error and opcode in _REQUESTS:
            text = name_of(self.forced_error)
            raise FoeError(text, code=self.forced_error, text=text)
        if opcode is FoeOpcode.READ:
            self.reset()
            self._reader = self._store.open_read(text_of(body), header.number)
            return self._send_next(self._reader, 1)
        if opcode is FoeOpcode.WRITE:
            self.reset()
            self._writer = self._store.open_write(text_of(body), header.number)
            self._number = 0
            self._busy_until_ns = now_ns
            # Data is counted from 1: 0 answers the request.
            return [encode_message(FoeOpcode.ACK, 0)]
        if opcode is FoeOpcode.ERROR:
            self.reset()
            return []
        if opcode is FoeOpcode.DATA and self._writer is not None:
            return self._write_packet(self._writer, header.number, body, now_ns)
        if opcode is FoeOpcode.ACK and self._reader is not None:
            return self._confirm(self._reader, header.number)
        # A client may be busy as well: its BUSY asks for the last packet again.
        if opcode is FoeOpcode.BUSY and self._reader is not None:
            return [self._sent]
        raise FoeError(f"{opcode.name} without a transfer", code=FoeErrorCode.ILLEGAL)

    def _confirm(self, reader: FileReader, number: int) -> list[bytes]:
        if number != self._number:
            raise _wrong_number(number, self._number)
        if self._is_last:
            self.reset()
            return []
        return self._send_next(reader, number + 1)

    def _send_next(self, reader: FileReader, number: int) -> list[bytes]:
        packet_size = self._sizes.to_master - DATA_OVERHEAD
        data = reader.read(packet_size)
        self._number = number
        # The end is a packet that is not full, so a file of whole packets ends with an empty one.
        self._is_last = len(data) < packet_size
        self._sent = encode_message(FoeOpcode.DATA, number, data)
        return [self._sent]

    def _write_packet(
        self, writer: FileWriter, number: int, data: bytes, now_ns: int
    ) -> list[bytes]:
        if number != self._number + 1:
            raise _wrong_number(number, self._number + 1)
        if now_ns < self._busy_until_ns:
            entire = max(1, self._busy_until_ns - self._busy_from_ns)
            done = (now_ns - self._busy_from_ns) * 100 // entire
            # BUSY carries progress; the master repeats the same packet later.
            return [encode_message(FoeOpcode.BUSY, Busy(done, 100).number)]
        writer.write(data)
        if len(data) < self._sizes.to_slave - DATA_OVERHEAD:
            writer.commit()
            self._writer = None
        self._busy_from_ns, self._busy_until_ns = now_ns, now_ns + self.packet_time_ns
        self._number = number
        return [encode_message(FoeOpcode.ACK, number)]


def _wrong_number(number: int, expected: int) -> FoeError:
    text = f"packet {number}, expected {expected}"
    return FoeError(text, code=FoeErrorCode.PACKET_NUMBER, text=text)


class AllowedIn(Enum):
    """States of the slave in which a file exists."""

    ANY_STATE = auto()
    BOOT = auto()
    OTHERS = auto()


class MemoryFile:
    """One file of a MemoryStore.

    Args:
        name: File name in FoE requests.
        content: Initial content.
        password: Required password.
        readable, writable: Access rights.
        allowed_in: States in which the file exists.
        max_size: Maximum size in bytes.
        check: Called with the new content before it replaces the old; refuses with FoeError.
    """

    def __init__(
        self,
        name: str,
        content: bytes = b"",
        *,
        password: int = 0,
        readable: bool = True,
        writable: bool = True,
        allowed_in: AllowedIn = AllowedIn.ANY_STATE,
        max_size: int = 1 << 22,
        check: Callable[[bytes], None] | None = None,
    ) -> None:
        self.name = name
        self.content = content
        self.password = password
        self.readable = readable
        self.writable = writable
        self.allowed_in = allowed_in
        self.max_size = max_size
        self.check = check


class MemoryStore:
    """Files of one slave in memory.

    Args:
        files: Initial files.
        is_boot: Returns true while the slave is in state BOOT.
        creates: Allows writing a file that does not exist.
        overwrites: Allows writing an existing file, within the file's own rules.
    """

    def __init__(
        self,
        files: Iterable[MemoryFile] = (),
        *,
        is_boot: Callable[[], bool] = bool,
        creates: bool = False,
        overwrites: bool = True,
    ) -> None:
        self.files = {file.name: file for file in files}
        self._is_boot = is_boot
        self._creates = creates
        self._overwrites = overwrites

    def open_read(self, name: str, password: int) -> MemoryReader:
        """Open a file for reading."""
        file = self.files.get(name)
        if file is None:
            raise store_error(FoeErrorCode.NOT_FOUND, name)
        self._check(file, password, is_allowed=file.readable)
        return MemoryReader(file.content)

    def open_write(self, name: str, password: int) -> MemoryWriter:
        """Open a file for writing from its start."""
        file = self.files.get(name)
        if file is None:
            if not self._creates or not name:
                raise store_error(FoeErrorCode.NOT_FOUND, name)
            return MemoryWriter(MemoryFile(name), self.files)
        self._check(file, password, is_allowed=file.writable)
        if not self._overwrites:
            raise store_error(FoeErrorCode.ALREADY_EXISTS, name)
        return MemoryWriter(file, self.files)

    def _check(self, file: MemoryFile, password: int, *, is_allowed: bool) -> None:
        if file.allowed_in is AllowedIn.BOOT and not self._is_boot():
            raise store_error(FoeErrorCode.BOOTSTRAP_ONLY, file.name)
        if file.allowed_in is AllowedIn.OTHERS and self._is_boot():
            raise store_error(FoeErrorCode.NOT_IN_BOOTSTRAP, file.name)
        if password != file.password:
            raise store_error(FoeErrorCode.NO_RIGHTS, file.name)
        if not is_allowed:
            raise store_error(FoeErrorCode.ACCESS_DENIED, file.name)


class MemoryReader:
    """File opened for reading, with its content at the time of opening."""

    def __init__(self, content: bytes) -> None:
        self._rest = memoryview(content)

    def read(self, size: int, /) -> bytes:
        """Return the next bytes."""
        data, self._rest = bytes(self._rest[:size]), self._rest[size:]
        return data

    def close(self) -> None:
        """Release the content."""
        self._rest = memoryview(b"")


class MemoryWriter:
    """File opened for writing; its old content stays until the new content is complete."""

    def __init__(self, file: MemoryFile, files: dict[str, MemoryFile]) -> None:
        self._file = file
        self._files = files
        self._content = bytearray()

    def write(self, data: bytes, /) -> None:
        """Append *data*."""
        if len(self._content) + len(data) > self._file.max_size:
            raise store_error(FoeErrorCode.DISK_FULL, self._file.name)
        self._content += data

    def commit(self) -> None:
        """Replace the file's content by the written data."""
        content = bytes(self._content)
        # Checked before the content is replaced: a refused file leaves the old one intact.
        if self._file.check is not None:
            self._file.check(content)
        self._file.content = content
        self._files[self._file.name] = self._file

    def discard(self) -> None:
        """Discard the written data."""
        self._content.clear()


def store_error(code: FoeErrorCode, what: str) -> FoeError:
    """Return the FoeError of a refused request; the master receives its code and text."""
    text = f"{what}: {name_of(code)}"
    return FoeError(text, code=code, text=text)
