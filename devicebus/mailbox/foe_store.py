"""Files of a simulated slave, in memory, each with its own rules for reading and writing."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import Enum, auto

from devicebus.errors import FoeError
from eap.codec.foe import FoeErrorCode, name_of


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
        max_size: Octets it may grow to.
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
        """Return the next octets."""
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
        """Take the next octets."""
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
