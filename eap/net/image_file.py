"""A process image in a file that processes share, and the futex that wakes programs for a cycle.

The file is mapped, not read: a restarted engine finds its counters, and programs that attached stay
attached.  A station whose layout changed gets a new file under the same name.  RETIRED is set in
each file that must not be used: in the new one until it holds what the old one held, and in the old
one from the moment in which the new one has its name.  A program that sees RETIRED opens the path
again.  A program that has just written checks it: the write may be too late to be carried over.
:class:`StationImage` follows the path, for programs that keep an image for long.
"""

from __future__ import annotations

import ctypes
import fcntl
import mmap
import os
import struct
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from eap.closeable import Closeable
from eap.errors import EnvironmentalError, ImageError, WriterConflictError
from eap.pd.handover import ImageHandover
from eap.pd.image import Image, format_image, read_generation, read_header
from eap.pd.layout import WORDS_OFFSET, ImageLayout
from eap.pd.spec import Writer
from eap.pd.words import StationWord

_libc = ctypes.CDLL(None, use_errno=True)
# The C library has no function for it, and the number depends on the architecture.
_SYS_FUTEX = {"x86_64": 202, "aarch64": 98, "armv7l": 240, "riscv64": 98}.get(os.uname().machine)
_FUTEX_WAIT, _FUTEX_WAKE = 0, 1
_ALL_WAITERS = 0x7FFFFFFF
_REPLACING_PAUSES = 20_000
"""Two seconds in all.  Replacing takes milliseconds; an engine that dies meanwhile comes back."""
_FLOCK = struct.Struct("hhqqi4x")
_PID_WORD = {
    Writer.ENGINE: StationWord.ENGINE_PID,
    Writer.SERVICES: StationWord.SERVICES_PID,
    Writer.APPLICATION: StationWord.APPLICATION_PID,
}


class ImageFile(Closeable):
    """A mapped process image; use it as a context manager or :meth:`close` it.

    Attributes:
        image: Named access to the variables and words.
        generation: Counts the layouts that the station has had.
    """

    def __init__(self, path: Path, descriptor: int, layout: ImageLayout | None = None) -> None:
        """Map a formatted image; its directory is not read if *layout* is known."""
        self.path = path
        self._fd = descriptor
        self._map = mmap.mmap(descriptor, 0)
        self._view = memoryview(self._map)
        if layout is None:
            layout, self.generation = read_header(self._view)
        else:
            self.generation = read_generation(self._view)
        self.image = Image(self._view, layout, pause=_pause)
        self._futex = ctypes.c_uint32.from_buffer(self._map, WORDS_OFFSET + 8 * StationWord.FUTEX)

    def close(self) -> None:
        """Close the descriptor, which also gives up the right to write.

        The mapping goes with the last view of it; a view that outlives the file does no harm.
        """
        if self._fd >= 0:
            # The mapping has a descriptor of its own, which would keep the locks.
            everything = _FLOCK.pack(fcntl.F_UNLCK, os.SEEK_SET, 0, 0, 0)
            with suppress(OSError):
                fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, everything)
            os.close(self._fd)
            self._fd = -1

    @property
    def retired(self) -> bool:
        """True if a file of a newer layout has taken this one's place."""
        return bool(self.image.words[StationWord.RETIRED])

    def move_to(self, path: Path) -> None:
        """Rename the file to *path*; programs that open it wait until :meth:`release`.

        Raises:
            EnvironmentalError: that is not possible; the old file is still there.
        """
        try:
            self.path = self.path.rename(path)
        except OSError as exc:
            raise EnvironmentalError(f"{path}: the process image cannot be made: {exc}") from None

    def retire(self) -> None:
        """Send programs to the file that has taken the name of this one."""
        words = self.image.words
        words[StationWord.RETIRED] = 1
        # Who has looked before, and is about to sleep on the futex, does not.
        words[StationWord.FUTEX] = words[StationWord.FUTEX] + 1 & 0xFFFFFFFF

    def release(self) -> None:
        """Allow programs to use a file that was made by :func:`prepare_image`."""
        self.image.words[StationWord.RETIRED] = 0

    def discard(self) -> None:
        """Remove a file that has replaced no other, and close it."""
        self.path.unlink(missing_ok=True)
        self.close()

    @property
    def is_replaced(self) -> bool:
        """True if another file has it, also if an engine died before it retired this one."""
        try:
            return not os.path.samestat(os.fstat(self._fd), self.path.stat())
        except OSError:
            return True

    def acquire_writer(self, writer: Writer) -> None:
        """Acquire the right to write the region of *writer*, until release or :meth:`close`.

        Raises:
            WriterConflictError: another attachment holds it, in this process or another.
        """
        # A lock of the open file, not of the process: it ends with this object or its process,
        # however that ends, and a second attachment of one program is a second writer too.
        word = _PID_WORD[writer]
        try:
            fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, _lock_of(writer, fcntl.F_WRLCK))
        except BlockingIOError:
            holder = _describe(self.image.words[word])
            raise WriterConflictError(
                f"station {self.image.layout.station}: the {writer} variables are being written "
                f"by {holder}; end it first",
                holder=holder,
            ) from None
        self.image.words[word] = os.getpid()

    def release_writer(self, writer: Writer) -> None:
        """Give up the right to write the region of *writer*."""
        fcntl.fcntl(self._fd, fcntl.F_OFD_SETLK, _lock_of(writer, fcntl.F_UNLCK))

    def wake_waiters(self) -> None:
        """Wake every process that sleeps in :meth:`wait_cycle`."""
        _libc.syscall(
            _SYS_FUTEX, ctypes.byref(self._futex), _FUTEX_WAKE, _ALL_WAITERS, None, None, 0
        )

    def wait_cycle(self, cycle: int, timeout_s: float) -> bool:
        """Sleep until the cycle counter differs from *cycle*.

        Return False after *timeout_s*, or when a newer layout has taken this file's place.
        """
        words = self.image.words
        deadline_ns = time.monotonic_ns() + int(timeout_s * 1e9)
        # The kernel sleeps only while the futex still is what it was before we looked at the
        # counter; an engine that was killed between the two words must not make us spin.
        seen = self._futex.value
        while words[StationWord.CYCLE] == cycle:
            remaining_ns = deadline_ns - time.monotonic_ns()
            if remaining_ns <= 0 or words[StationWord.RETIRED]:
                return False
            # Before the sleep: the engine wakes only for about as long as a waiter was announced
            # lately.
            words[StationWord.WAITERS] = cycle
            limit = (ctypes.c_long * 2)(*divmod(remaining_ns, 1_000_000_000))
            _libc.syscall(
                _SYS_FUTEX,
                ctypes.byref(self._futex),
                _FUTEX_WAIT,
                # A cycle that ended since `seen` was read makes the kernel return at once: no
                # wake-up is lost.
                ctypes.c_uint32(seen),
                limit,
                None,
                0,
            )
            seen = self._futex.value
        return True


def create_image(path: Path, layout: ImageLayout) -> ImageFile:
    """Open the image of a station for its engine, a fresh one if the layout is new.

    Raises:
        EnvironmentalError: the folder cannot be written.
    """
    for left_over in path.parent.glob(f".{path.name}.*"):
        left_over.unlink()  # of an engine that was killed while it made one
    try:
        existing = _open(path)
    except ImageError:
        return _replace(None, prepare_image(path, layout, 1), path)
    if existing.image.layout == layout:
        existing.release()
        return existing
    fresh = prepare_image(path, layout, existing.generation + 1)
    return _replace(existing, fresh, path)


def _replace(existing: ImageFile | None, fresh: ImageFile, path: Path) -> ImageFile:
    try:
        # Still retired at that moment: a program that opens the path waits until the content is
        # there.
        fresh.move_to(path)
    except EnvironmentalError:
        fresh.discard()
        raise
    if existing is not None:
        # Before the copy: a program that still writes the old file sees RETIRED and writes again.
        existing.retire()
        handover = ImageHandover(existing.image, fresh.image)
        handover.carry_words()
        handover.carry_values(existing.image.memory)
    fresh.release()
    if existing is not None:
        existing.wake_waiters()
        existing.close()
    return fresh


def prepare_image(path: Path, layout: ImageLayout, generation: int) -> ImageFile:
    """Make a fresh image beside the file at *path*, which it will replace; it is retired at first.

    Raises:
        EnvironmentalError: the folder cannot be written.
    """
    fresh = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        descriptor = os.open(fresh, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
    except OSError as exc:
        raise EnvironmentalError(f"{path}: the process image cannot be made: {exc}") from None
    try:
        # With ftruncate alone a full disk would be a SIGBUS at the first write to a page.
        os.posix_fallocate(descriptor, 0, layout.size)
        with mmap.mmap(descriptor, 0) as memory, memoryview(memory) as view:
            _format(view, layout, generation)
    except OSError as exc:
        os.close(descriptor)
        fresh.unlink(missing_ok=True)
        raise EnvironmentalError(f"{path}: the process image cannot be made: {exc}") from None
    return ImageFile(fresh, descriptor, layout)


def open_image(path: Path) -> ImageFile:
    """Open an existing image; wait a moment while it is being replaced.

    Raises:
        ImageError: there is none, or it is no image of this release, or its engine died while it
            replaced it.
    """
    for _ in range(_REPLACING_PAUSES):
        file = _open(path)
        if not file.retired:
            return file
        file.close()
        _pause()
    raise ImageError(f"{path}: the process image is being replaced, and that does not end")


def _open(path: Path) -> ImageFile:
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except OSError as exc:
        raise ImageError(f"{path}: no process image: {exc.strerror}") from None
    try:
        return ImageFile(path, descriptor)
    except (ImageError, ValueError) as exc:
        os.close(descriptor)
        raise ImageError(f"{path}: {exc}") from None


def _format(view: memoryview, layout: ImageLayout, generation: int) -> None:
    image = format_image(view, layout, generation)
    image.words[StationWord.RETIRED] = 1
    image.words.release()
    image.memory.release()


def _pause() -> None:
    """Yield the processor to a writer that was interrupted in the middle."""
    _libc.usleep(100)


def _lock_of(writer: Writer, kind: int) -> bytes:
    """Return the request for the byte that stands for *writer*."""
    return _FLOCK.pack(kind, os.SEEK_SET, list(Writer).index(writer), 1, 0)


def _describe(pid: int) -> str:
    try:
        command = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode().strip()
    except (OSError, UnicodeDecodeError):
        command = "unknown program"
    return f"process {pid} ({command[:80]})"


class StationImage:
    """The newest process image of one station.

    Raises:
        ImageError: there is none.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = open_image(path)
        self._writers: set[Writer] = set()

    def close(self) -> None:
        """Release the file, and of the right to write."""
        self._file.close()

    @property
    def image(self) -> Image:
        """Named access to the newest image; raise ImageError if it cannot be opened."""
        return self.file.image

    @property
    def file(self) -> ImageFile:
        """The newest file; raises as :attr:`image` does."""
        if self._file.retired:
            self._move()
        return self._file

    def acquire_writer(self, writer: Writer) -> None:
        """Acquire the right to write the region of *writer*, in newer images too.

        Raises:
            WriterConflictError: another attachment holds it.
            ImageError: the image cannot be opened.
        """
        self.file.acquire_writer(writer)
        self._writers.add(writer)

    def release_writer(self, writer: Writer) -> None:
        """Give up the right to write the region of *writer*."""
        self._writers.discard(writer)
        self._file.release_writer(writer)

    def write(self, writer: Writer, values: Mapping[str, Any]) -> None:
        """Write *values* at once; none is lost when the image changes meanwhile.

        The caller is the region's writer.

        Raises:
            ValueError: a value does not fit its type; nothing was written.
            ImageError: there is no such variable (any more); nothing was written.
        """
        while True:
            file = self.file
            fresh = file.image.updated_region(writer, values)
            # One copy: a cycle that begins within this block goes on with the values before.
            with file.image.writing(writer):
                file.image.region(writer)[:] = fresh
            # A write that came too late for the handover is made again in the new file.
            if not file.retired:
                return

    def write_once(self, writer: Writer, values: Mapping[str, Any]) -> None:
        """Write *values* at once, holding the right to write only for that time.

        Raises:
            WriterConflictError: another attachment holds it.
            ValueError, ImageError: as :meth:`write` does.
        """
        self.acquire_writer(writer)
        try:
            self.write(writer, values)
        finally:
            self.release_writer(writer)

    def reopen_if_replaced(self) -> bool:
        """Reopen the path if another file has replaced the image; return whether one has."""
        if not self._file.is_replaced:
            return False
        self._move()
        return True

    def _move(self) -> None:
        fresh = open_image(self._path)
        try:
            for writer in self._writers:
                fresh.acquire_writer(writer)
        except BaseException:
            fresh.close()
            raise
        self._file.close()
        self._file = fresh
