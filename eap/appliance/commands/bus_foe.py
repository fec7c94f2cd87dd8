"""Files of slaves: to and from files of this machine, without holding them in memory."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

from devicebus.errors import MailboxSizeError
from devicebus.mailbox import foe_client, voe_client
from devicebus.mailbox.conversation import Progress
from eap.appliance.commands.bus_slave import SlaveBus
from eap.errors import ConfigError, EnvironmentalError

Report: TypeAlias = Callable[[int, int | None], None]
"""Called now and then with the octets done, and how many there are if that is known."""


def get_file(
    bus: SlaveBus, slave: str, name: str, target: Path, *, password: int, report: Report
) -> dict[str, Any]:
    """Read the file *name* of a slave into *target*, which appears once it is complete.

    Raises:
        FoeError: the slave refuses.
        BusError: there is no such slave, or it does not answer.
        ConfigError: the slave's mailbox is too small for *name*.
        EnvironmentalError: *target* cannot be written.
    """
    unit = bus.find(slave)
    partial = target.with_name(f"{target.name}.part")
    progress = Progress()
    digest = hashlib.sha256()
    start = time.monotonic()
    try:
        with partial.open("wb") as file:

            def sink(data: bytes) -> None:
                file.write(data)
                digest.update(data)

            bus.converse(
                unit,
                lambda sizes: foe_client.read(
                    name, sink, sizes, password=password, progress=progress
                ),
                f"FoE read of {name!r}",
                lambda: report(progress.done, None),
            )
            file.flush()
            os.fsync(file.fileno())
        partial.replace(target)
    except MailboxSizeError as exc:
        raise ConfigError(f"file {name!r}: {exc}") from None
    except OSError as exc:
        raise EnvironmentalError(f"{target} cannot be written: {exc.strerror}") from None
    finally:
        partial.unlink(missing_ok=True)
    report(progress.done, progress.done)
    return _summary(unit.station, name, target, progress, time.monotonic() - start) | {
        "sha256": digest.hexdigest()
    }


def put_file(
    bus: SlaveBus, slave: str, source: Path, name: str, *, password: int, report: Report
) -> dict[str, Any]:
    """Write *source* to a slave as the file *name*.

    Raises:
        FoeError: the slave refuses.
        BusError: there is no such slave, or it does not answer.
        ConfigError: the slave's mailbox is too small for *name*.
        EnvironmentalError: *source* cannot be read.
    """
    unit = bus.find(slave)
    digest = hashlib.sha256()
    start = time.monotonic()
    try:
        with source.open("rb") as file:
            progress = Progress(os.fstat(file.fileno()).st_size)

            def take(size: int) -> bytes:
                data = file.read(size)
                digest.update(data)
                return data

            bus.converse(
                unit,
                lambda sizes: foe_client.write(
                    name, take, sizes, password=password, progress=progress
                ),
                f"FoE write of {name!r}",
                lambda: report(progress.done, progress.total),
            )
    except MailboxSizeError as exc:
        raise ConfigError(f"file {name!r}: {exc}") from None
    except OSError as exc:
        raise EnvironmentalError(f"{source} cannot be read: {exc.strerror}") from None
    report(progress.done, progress.done)
    return _summary(unit.station, name, source, progress, time.monotonic() - start) | {
        "sha256": digest.hexdigest()
    }


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
    station: int, name: str, path: Path, progress: Progress, seconds: float
) -> dict[str, Any]:
    return {
        "slave": station,
        "name": name,
        "file": str(path),
        "octets": progress.done,
        "seconds": round(seconds, 3),
        "rate": round(progress.done / seconds) if seconds else 0,
    }
