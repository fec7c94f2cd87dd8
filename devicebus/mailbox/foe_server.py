"""FoE on the side of a slave: files read and written one message at a time (ETG.1000.6).

Where the files are is somebody else's concern: a :class:`FileStore`, such as
:class:`devicebus.mailbox.foe_server.MemoryStore`, opens them and refuses with FoeError.
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
    """A file that is being read; any binary file object is one."""

    def read(self, size: int, /) -> bytes:
        """Return the next *size* bytes, fewer only at the end."""

    def close(self) -> None:
        """Nothing more will be read."""


class FileWriter(Protocol):
    """A file that is being written; each method may raise FoeError."""

    def write(self, data: bytes, /) -> object:
        """Take the next bytes."""

    def commit(self) -> None:
        """Make what was written the content of the file: it is complete."""

    def discard(self) -> None:
        """Forget what was written: the rest will not come."""


class FileStore(Protocol):
    """Store of a slave's files; each method may raise FoeError."""

    def open_read(self, name: str, password: int) -> FileReader:
        """Open a file for reading."""

    def open_write(self, name: str, password: int) -> FileWriter:
        """Open a file for writing from its start."""


class FoeServer:
    """The FoE protocol of a slave; one transfer at a time, a new request ends the one before.

    Args:
        store: The files.
        sizes: Of the slave's mailboxes.

    Attributes:
        packet_time_ns: How long storing the data of one message takes; until then the slave says
            that it is busy.
        refuses: Error code with which every request is refused; 0 refuses none.
    """

    def __init__(self, store: FileStore, sizes: MailboxSizes, *, packet_time_ns: int = 0) -> None:
        self._store = store
        self._sizes = sizes
        self.packet_time_ns = packet_time_ns
        self.refuses = 0
        self._reader: FileReader | None = None
        self._writer: FileWriter | None = None
        self._number = 0
        self._sent = b""
        self._is_last = False
        self._busy_from_ns = self._busy_until_ns = 0

    def reset(self) -> None:
        """Forget the transfer under way."""
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
        """Act on a message behind its mailbox header and return the answer."""
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
        if self.refuses and opcode in _REQUESTS:
            text = name_of(self.refuses)
            raise FoeError(text, code=self.refuses, text=text)
        if opcode is FoeOpcode.READ:
            self.reset()
            self._reader = self._store.open_read(text_of(body), header.number)
            return self._send_next(self._reader, 1)
        if opcode is FoeOpcode.WRITE:
            self.reset()
            self._writer = self._store.open_write(text_of(body), header.number)
            self._number = 0
            self._busy_until_ns = now_ns
            return [encode_message(FoeOpcode.ACK, 0)]
        if opcode is FoeOpcode.ERROR:
            self.reset()
            return []
        if opcode is FoeOpcode.DATA and self._writer is not None:
            return self._take(self._writer, header.number, body, now_ns)
        if opcode is FoeOpcode.ACK and self._reader is not None:
            return self._confirm(self._reader, header.number)
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
        room = self._sizes.to_master - DATA_OVERHEAD
        data = reader.read(room)
        self._number = number
        self._is_last = len(data) < room
        self._sent = encode_message(FoeOpcode.DATA, number, data)
        return [self._sent]

    def _take(self, writer: FileWriter, number: int, data: bytes, now_ns: int) -> list[bytes]:
        if number != self._number + 1:
            raise _wrong_number(number, self._number + 1)
        if now_ns < self._busy_until_ns:
            entire = max(1, self._busy_until_ns - self._busy_from_ns)
            done = (now_ns - self._busy_from_ns) * 100 // entire
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
    """In which state of its slave a file is there."""

    ANY_STATE = auto()
    BOOT = auto()
    OTHERS = auto()


class MemoryFile:
    """One file.

    Args:
        name: As FoE asks for it.
        content: What it starts with.
        password: What a request must carry.
        readable, writable: What may be done with it.
        allowed_in: In which state.
        max_size: Bytes it may grow to.
        check: Called with the content before it replaces the old one; refuses with FoeError.
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
    """The files of one slave.

    Args:
        files: What is there from the start.
        is_boot: Says whether the slave is in state BOOT.
        creates: Whether a file that is not there may be written.
        overwrites: Whether one that is there may be; a file's own rules hold besides.
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
            raise refusal(FoeErrorCode.NOT_FOUND, name)
        self._check(file, password, is_allowed=file.readable)
        return MemoryReader(file.content)

    def open_write(self, name: str, password: int) -> MemoryWriter:
        """Open a file for writing from its start."""
        file = self.files.get(name)
        if file is None:
            if not self._creates or not name:
                raise refusal(FoeErrorCode.NOT_FOUND, name)
            return MemoryWriter(MemoryFile(name), self.files)
        self._check(file, password, is_allowed=file.writable)
        if not self._overwrites:
            raise refusal(FoeErrorCode.ALREADY_EXISTS, name)
        return MemoryWriter(file, self.files)

    def _check(self, file: MemoryFile, password: int, *, is_allowed: bool) -> None:
        if file.allowed_in is AllowedIn.BOOT and not self._is_boot():
            raise refusal(FoeErrorCode.BOOTSTRAP_ONLY, file.name)
        if file.allowed_in is AllowedIn.OTHERS and self._is_boot():
            raise refusal(FoeErrorCode.NOT_IN_BOOTSTRAP, file.name)
        if password != file.password:
            raise refusal(FoeErrorCode.NO_RIGHTS, file.name)
        if not is_allowed:
            raise refusal(FoeErrorCode.ACCESS_DENIED, file.name)


class MemoryReader:
    """A file that is being read; it keeps the content that it was opened with."""

    def __init__(self, content: bytes) -> None:
        self._rest = memoryview(content)

    def read(self, size: int, /) -> bytes:
        """Return the next bytes."""
        data, self._rest = bytes(self._rest[:size]), self._rest[size:]
        return data

    def close(self) -> None:
        """Let go of the content."""
        self._rest = memoryview(b"")


class MemoryWriter:
    """A file that is being written; its old content stays until the new one is complete."""

    def __init__(self, file: MemoryFile, files: dict[str, MemoryFile]) -> None:
        self._file = file
        self._files = files
        self._content = bytearray()

    def write(self, data: bytes, /) -> None:
        """Take the next bytes."""
        if len(self._content) + len(data) > self._file.max_size:
            raise refusal(FoeErrorCode.DISK_FULL, self._file.name)
        self._content += data

    def commit(self) -> None:
        """Make what was written the content of the file."""
        content = bytes(self._content)
        if self._file.check is not None:
            self._file.check(content)
        self._file.content = content
        self._files[self._file.name] = self._file

    def discard(self) -> None:
        """Forget what was written."""
        self._content.clear()


def refusal(code: FoeErrorCode, what: str) -> FoeError:
    """Make the error with which a store refuses; the master gets the code and these words."""
    text = f"{what}: {name_of(code)}"
    return FoeError(text, code=code, text=text)
