"""Files of slaves: to and from files of this machine, without holding them in memory."""

from __future__ import annotations

import hashlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

from devicebus.errors import MailboxSizeError
from devicebus.mailbox import foe_client, voe_client
from devicebus.mailbox.conversation import Progress
from eap.appliance.commands.bus_slave import Begin, Slave, SlaveBus
from eap.appliance.durable import whole_file
from eap.errors import ConfigError, EapError, EnvironmentalError

Report: TypeAlias = Callable[[int, int | None], None]
"""Called now and then with the octets done, and how many there are if that is known."""


def get_file(
    bus: SlaveBus, slave: str, name: str, target: Path | None, *, password: int, report: Report
) -> dict[str, Any]:
    """Read the file *name* of a slave into *target*, None for stdout.

    A regular file appears once it is complete; a pipe or a device is written as it is.

    Raises:
        FoeError: the slave refuses.
        BusError: there is no such slave, or it does not answer.
        ConfigError: the slave's mailbox is too small for *name*.
        EnvironmentalError: *target* cannot be written.
    """
    unit = _find(bus, slave)
    progress = Progress()
    digest = hashlib.sha256()
    start = time.monotonic()
    with _writing(target) as file, _telling_how_far(progress, "read"):

        def sink(data: bytes) -> None:
            file.write(data)
            digest.update(data)

        _converse(
            bus,
            unit,
            lambda sizes: foe_client.read(name, sink, sizes, password=password, progress=progress),
            f"FoE read of {name!r}",
            lambda: report(progress.done, None),
        )
    report(progress.done, progress.done)
    return _summary(unit.station, name, target, progress, time.monotonic() - start) | {
        "sha256": digest.hexdigest()
    }


def put_file(
    bus: SlaveBus, slave: str, source: Path | None, name: str, *, password: int, report: Report
) -> dict[str, Any]:
    """Write *source*, None for stdin, to a slave as the file *name*.

    Raises:
        FoeError: the slave refuses.
        BusError: there is no such slave, or it does not answer.
        ConfigError: the slave's mailbox is too small for *name*.
        EnvironmentalError: *source* cannot be read.
    """
    unit = _find(bus, slave)
    digest = hashlib.sha256()
    start = time.monotonic()
    with _reading(source) as file:
        is_regular = source is not None and source.is_file()
        progress = Progress(os.fstat(file.fileno()).st_size if is_regular else None)

        def take(size: int) -> bytes:
            data = file.read(size)
            digest.update(data)
            return data

        with _telling_how_far(progress, "written"):
            _converse(
                bus,
                unit,
                lambda sizes: foe_client.write(
                    name, take, sizes, password=password, progress=progress
                ),
                f"FoE write of {name!r}",
                lambda: report(progress.done, progress.total),
            )
    report(progress.done, progress.done)
    return _summary(unit.station, name, source, progress, time.monotonic() - start) | {
        "sha256": digest.hexdigest()
    }


@contextmanager
def _writing(target: Path | None) -> Iterator[BinaryIO]:
    """Open what is to be written; a regular file is replaced when the block is through."""
    if target is None:
        try:
            yield sys.stdout.buffer
            sys.stdout.buffer.flush()
        except BrokenPipeError:
            raise  # who reads it has seen enough
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
def _telling_how_far(progress: Progress, done: str) -> Iterator[None]:
    """Note on whatever ends a transfer early how far it came."""
    try:
        yield
    except (EapError, KeyboardInterrupt) as exc:
        if progress.done:
            of = f" of {progress.total}" if progress.total else ""
            exc.add_note(
                f"{progress.done}{of} octets were {done}; FoE does not go on in the middle of a"
                " file: the same command begins anew"
            )
        raise


def _converse(
    bus: SlaveBus, unit: Slave, begin: Begin[int], name: str, meanwhile: Callable[[], None]
) -> None:
    try:
        bus.converse(unit, begin, name, meanwhile)
    except MailboxSizeError as exc:
        raise ConfigError(str(exc)) from None


def _find(bus: SlaveBus, slave: str) -> Slave:
    unit = bus.find(slave)
    bus.require_mailbox(unit)
    return unit


def exchange(
    bus: SlaveBus, slave: str, vendor_id: int, vendor_type: int, data: bytes
) -> dict[str, Any]:
    """Send a VoE message to a slave and return its answer.

    Raises:
        BusError: there is no such slave, or it does not answer.
    """
    unit = bus.find(slave)
    answer = bus.converse(
        unit, lambda _: voe_client.exchange(vendor_id, vendor_type, data), "VoE request"
    )
    return {
        "slave": unit.station,
        "vendor_id": vendor_id,
        "vendor_type": vendor_type,
        "data": answer.hex(),
    }


def _summary(
    station: int, name: str, path: Path | None, progress: Progress, seconds: float
) -> dict[str, Any]:
    return {
        "slave": station,
        "name": name,
        "file": "-" if path is None else str(path),
        "octets": progress.done,
        "seconds": round(seconds, 3),
        "rate": round(progress.done / seconds) if seconds else 0,
    }
