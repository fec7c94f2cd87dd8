"""Files of slaves (FoE), to and from files of this machine, and vendor messages (VoE).

A file is never held in memory as a whole.
"""

from __future__ import annotations

import hashlib
import os
import select
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, TypeAlias

from msgspec import Struct

from devicebus.errors import BusError, MailboxSizeError
from devicebus.mailbox import foe_client, voe
from devicebus.mailbox.conversation import Conversation, Progress
from devicebus.mailbox.protocol import MailboxSizes
from eap.errors import ConfigError, EapError, EnvironmentalError
from eap.ops.bus_session import Begin, Slave, SlaveBus
from eap.runtime.durable import whole_file
from eap.runtime.foe_restart import PAUSE_S, Restarts

Report: TypeAlias = Callable[[int, int | None, int], None]
"""Progress callback: bytes done, their total if it is known, and the number of restarts."""


class FileTransfer(Struct, frozen=True, kw_only=True):
    """``eapctl bus foe``: a file that was transferred, *rate* in bytes a second."""

    slave: int
    name: str
    file: str
    octets: int
    seconds: float
    rate: int
    sha256: str
    restarts: int


class VendorReply(Struct, frozen=True):
    """``eapctl bus voe``: the answer to a vendor's message."""

    slave: int
    vendor_id: int
    vendor_type: int
    data: str


def get_file(
    bus: SlaveBus, slave: str, name: str, target: Path | None, *, password: int, report: Report
) -> FileTransfer:
    """Read the file *name* of a slave into *target*, None for stdout.

    A regular file appears once it is complete; a pipe or a device is written as it is.  A transfer
    that the bus interrupts begins anew, unless something was written that cannot be taken back.

    Raises:
        FoeError: the slave refuses.
        BusError: there is no such slave, or it does not answer.
        ConfigError: the slave's mailbox is too small for *name*.
        EnvironmentalError: *target* cannot be written.
    """
    progress = Progress()
    start = time.monotonic()
    with _writing(target) as file, _noting_progress(progress, "read"):
        digest = hashlib.sha256()

        def sink(data: bytes) -> None:
            file.write(data)
            digest.update(data)

        def rewind() -> None:
            nonlocal digest
            digest = hashlib.sha256()
            file.seek(0)
            file.truncate()

        def begin(sizes: MailboxSizes) -> Conversation[int]:
            return foe_client.read(name, sink, sizes, password=password, progress=progress)

        transfer = _FileCopy(bus, slave, begin, f"FoE read of {name!r}", progress)
        # Bytes that went to a pipe cannot be taken back: then a fault ends the transfer.
        restarts = transfer.run(rewind if target is not None and file.seekable() else None, report)
    report(progress.done, progress.done, restarts.count)
    seconds = time.monotonic() - start
    return transfer.summary(name, target, seconds, digest.hexdigest(), restarts)


def put_file(
    bus: SlaveBus, slave: str, source: Path | None, name: str, *, password: int, report: Report
) -> FileTransfer:
    """Write *source*, None for stdin, to a slave as the file *name*.

    A transfer that the bus interrupts restarts, unless *source* cannot be read again.

    Raises:
        FoeError: the slave refuses.
        BusError: there is no such slave, or it does not answer.
        ConfigError: the slave's mailbox is too small for *name*.
        EnvironmentalError: *source* cannot be read.
    """
    start = time.monotonic()
    with _reading(source) as file:
        # Only a regular file has a size and can be read again for a restart.
        is_regular = source is not None and source.is_file()
        progress = Progress(os.fstat(file.fileno()).st_size if is_regular else None)
        digest = hashlib.sha256()

        def take(size: int) -> bytes:
            data = file.read(size)
            digest.update(data)
            return data

        def rewind() -> None:
            nonlocal digest
            digest = hashlib.sha256()
            file.seek(0)

        def begin(sizes: MailboxSizes) -> Conversation[int]:
            return foe_client.write(name, take, sizes, password=password, progress=progress)

        transfer = _FileCopy(bus, slave, begin, f"FoE write of {name!r}", progress)
        with _noting_progress(progress, "written"):
            restarts = transfer.run(rewind if is_regular else None, report)
    report(progress.done, progress.done, restarts.count)
    seconds = time.monotonic() - start
    return transfer.summary(name, source, seconds, digest.hexdigest(), restarts)


class _FileCopy:
    """Transfer of one file to or from a slave."""

    def __init__(
        self, bus: SlaveBus, slave: str, begin: Begin[int], name: str, progress: Progress
    ) -> None:
        self._bus = bus
        self._slave = slave
        self._begin = begin
        self._name = name
        self._progress = progress
        self._unit = _find(bus, slave)

    def run(self, rewind: Callable[[], None] | None, report: Report) -> Restarts:
        """Transfer the file, again from its beginning after a fault of the bus."""
        progress = self._progress
        restarts = Restarts(progress, lambda: rewind is not None, time.monotonic)

        def meanwhile() -> None:
            report(progress.done, progress.total, restarts.count)

        while True:
            try:
                self._bus.converse(self._unit, self._begin, self._name, meanwhile)
            except MailboxSizeError as exc:
                raise ConfigError(str(exc)) from None
            except BusError as exc:
                if not restarts.allows(exc):
                    _note_restarts(exc, restarts)
                    raise
            else:
                return restarts
            assert rewind is not None  # noqa: S101  else no restart is allowed
            rewind()
            meanwhile()
            select.select([], [], [], PAUSE_S)
            # A slave that lost power has a new mailbox, and perhaps another position.
            with suppress(BusError):  # the next attempt reports the reason
                self._bus.scan()
                self._unit = _find(self._bus, self._slave)

    def summary(
        self, name: str, path: Path | None, seconds: float, sha256: str, restarts: Restarts
    ) -> FileTransfer:
        """Return the result of the whole transfer."""
        done = self._progress.done
        return FileTransfer(
            slave=self._unit.station,
            name=name,
            file="-" if path is None else str(path),
            octets=done,
            seconds=round(seconds, 3),
            rate=round(done / seconds) if seconds else 0,
            sha256=sha256,
            restarts=restarts.count,
        )


def _note_restarts(exc: BusError, restarts: Restarts) -> None:
    if restarts.count:
        exc.add_note(
            f"the transfer restarted {restarts.count} times, last after: {restarts.reason}"
        )


@contextmanager
def _writing(target: Path | None) -> Iterator[BinaryIO]:
    """Open the target; a regular file is replaced when the block ends."""
    if target is None:
        try:
            yield sys.stdout.buffer
            sys.stdout.buffer.flush()
        except BrokenPipeError:
            raise  # the reader closed the pipe: main() ends the command quietly
        except OSError as exc:
            raise EnvironmentalError(f"stdout cannot be written: {exc.strerror}") from None
        return
    with whole_file(target) as file:
        yield file


@contextmanager
def _reading(source: Path | None) -> Iterator[BinaryIO]:
    if source is None:
        yield sys.stdin.buffer
        return
    try:
        with source.open("rb") as file:
            yield file
    except OSError as exc:
        raise EnvironmentalError(f"{source} cannot be read: {exc.strerror}") from None


@contextmanager
def _noting_progress(progress: Progress, done: str) -> Iterator[None]:
    """Add the progress to the exception that ends a transfer early."""
    try:
        yield
    except (EapError, KeyboardInterrupt) as exc:
        if progress.done:
            of = f" of {progress.total}" if progress.total else ""
            exc.add_note(
                f"{progress.done}{of} bytes were {done}; FoE cannot resume a file: repeat the"
                " command"
            )
        raise


def _find(bus: SlaveBus, slave: str) -> Slave:
    unit = bus.find(slave)
    bus.require_mailbox(unit)
    return unit


def exchange(
    bus: SlaveBus, slave: str, vendor_id: int, vendor_type: int, data: bytes
) -> VendorReply:
    """Send a VoE message to a slave and return its answer.

    Raises:
        BusError: there is no such slave, or it does not answer.
    """
    unit = bus.find(slave)
    answer = bus.converse(unit, lambda _: voe.exchange(vendor_id, vendor_type, data), "VoE request")
    return VendorReply(unit.station, vendor_id, vendor_type, answer.hex())
