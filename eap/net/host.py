"""Values and passwords from files of this host: /proc, /sys, CSV recordings, password files."""

from __future__ import annotations

import csv
import os
import stat
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from eap.errors import EnvironmentalError
from eap.pd.spec import Measure

_TICKS_PER_SECOND = 100
"""USER_HZ: what /proc/stat counts in, on every architecture that Python runs on."""

Number = int | float


class Host:
    """Reads measurements; the processor share is that since the reading before.

    Args:
        root: Where ``proc`` and ``sys`` are; tests have their own.
    """

    def __init__(self, root: Path = Path("/")) -> None:
        self._proc = root / "proc"
        self._zones = root / "sys/class/thermal"
        self._cpu_before = (0, 0)
        self._cpu_percent = 0.0
        self._readers: Mapping[Measure, Callable[[str], Number]] = {
            Measure.LOAD1: lambda _: self._load(0),
            Measure.LOAD5: lambda _: self._load(1),
            Measure.LOAD15: lambda _: self._load(2),
            Measure.CPU_PERCENT: lambda _: self._cpu_share(),
            Measure.CPU_TIME: lambda _: self._cpu()[0] / _TICKS_PER_SECOND,
            Measure.MEMORY_TOTAL: lambda _: self._memory("MemTotal"),
            Measure.MEMORY_AVAILABLE: lambda _: self._memory("MemAvailable"),
            Measure.MEMORY_USED: lambda _: self._memory_used(),
            Measure.MEMORY_PERCENT: lambda _: self._memory_percent(),
            Measure.RX_OCTETS: lambda name: self._interface(name, 0),
            Measure.TX_OCTETS: lambda name: self._interface(name, 8),
            Measure.RX_PACKETS: lambda name: self._interface(name, 1),
            Measure.TX_PACKETS: lambda name: self._interface(name, 9),
            Measure.UPTIME: lambda _: self._uptime(),
            Measure.PROCESSES: lambda _: self._processes(),
            Measure.CONTEXT_SWITCHES: lambda _: self._stat("ctxt")[0],
            Measure.TEMPERATURE: self._temperature,
        }

    def read(self, measure: Measure, argument: str = "") -> Number:
        """Return *measure* as it is now, in the unit that docs/plant-file.md gives.

        Args:
            measure: What to read.
            argument: The network interface, or the thermal zone (the first one if empty).

        Raises:
            EnvironmentalError: this host has no such interface, zone or file.
        """
        try:
            return self._readers[measure](argument)
        except OSError as exc:
            raise EnvironmentalError(f"{measure}: {exc.filename}: {exc.strerror}") from None
        except (ValueError, IndexError, KeyError) as exc:
            raise EnvironmentalError(f"{measure}: {self._proc} is not as expected: {exc}") from None

    def _load(self, position: int) -> float:
        return float((self._proc / "loadavg").read_text().split()[position])

    def _processes(self) -> int:
        return int((self._proc / "loadavg").read_text().split()[3].partition("/")[2])

    def _uptime(self) -> float:
        return float((self._proc / "uptime").read_text().split()[0])

    def _memory(self, key: str) -> int:
        for line in (self._proc / "meminfo").read_text().splitlines():
            name, _, rest = line.partition(":")
            if name == key:
                return int(rest.split()[0])
        raise KeyError(key)

    def _memory_used(self) -> int:
        return self._memory("MemTotal") - self._memory("MemAvailable")

    def _memory_percent(self) -> float:
        return 100.0 * self._memory_used() / self._memory("MemTotal")

    def _stat(self, key: str) -> list[int]:
        for line in (self._proc / "stat").read_text().splitlines():
            name, *numbers = line.split()
            if name == key:
                return [int(number) for number in numbers]
        raise KeyError(key)

    def _cpu(self) -> tuple[int, int]:
        """Return busy and all ticks of all processors since the start of the host."""
        # Guest time, in columns 9 and 10, is in user and nice time already.
        ticks = self._stat("cpu")[:8]
        return sum(ticks) - sum(ticks[3:5]), sum(ticks)

    def _cpu_share(self) -> float:
        busy, total = self._cpu()
        busy_before, total_before = self._cpu_before
        # The counters grow by ticks of 10 ms: two readings within one tick have no share between
        # them.
        if total > total_before:
            self._cpu_percent = 100.0 * max(busy - busy_before, 0) / (total - total_before)
            self._cpu_before = busy, total
        return min(self._cpu_percent, 100.0)

    def _interface(self, name: str, column: int) -> int:
        for line in (self._proc / "net/dev").read_text().splitlines():
            interface, separator, numbers = line.partition(":")
            if separator and interface.strip() == name:
                return int(numbers.split()[column])
        raise EnvironmentalError(f"this host has no interface {name!r} to count traffic of")

    def _temperature(self, zone: str) -> float:
        if not zone:
            zones = sorted(each.name for each in self._zones.glob("thermal_zone*"))
            if not zones:
                raise EnvironmentalError("this host shows no temperature (no thermal zone in /sys)")
            zone = zones[0]
        return int((self._zones / zone / "temp").read_text()) / 1000


class CsvReplay:
    """One column of a file; values are texts, the variable's data type reads them."""

    def __init__(self, values: Sequence[str], period_ns: int) -> None:
        self._values = values
        self._period_ns = period_ns

    def value(self, elapsed_ns: int) -> str:
        """Return the value of the row at *elapsed_ns* after the start."""
        return self._values[elapsed_ns // self._period_ns % len(self._values)]


def open_replay(path: Path, column: str, *, period_ms: int) -> CsvReplay:
    """Read *column* of the file, whose first row names the columns.

    Raises:
        EnvironmentalError: the file cannot be read, or has no such column or no rows.
    """
    try:
        # utf-8-sig: spreadsheet programs put a byte order mark before the first name.
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.DictReader(file, strict=True)
            if column not in (rows.fieldnames or ()):
                raise EnvironmentalError(f"{path}: there is no column {column!r}")
            values = [row[column] or "" for row in rows]
    except OSError as exc:
        raise EnvironmentalError(f"{path}: {exc.strerror}") from None
    except (csv.Error, UnicodeDecodeError) as exc:
        raise EnvironmentalError(f"{path} is no CSV file in UTF-8: {exc}") from None
    if not values:
        raise EnvironmentalError(f"{path}: there are no rows below the names of the columns")
    return CsvReplay(values, period_ms * 1_000_000)


_MAX_SIZE = 4096


def read_password(file: Path) -> bytes:
    """Return the first line of *file* without its end, as far as 4096 bytes.

    Raises:
        EnvironmentalError: it cannot be read, or is no regular file.
    """
    try:
        # Opening a pipe would block until another process opens it for writing.
        with os.fdopen(os.open(file, os.O_RDONLY | os.O_NONBLOCK), "rb") as opened:
            if not stat.S_ISREG(os.fstat(opened.fileno()).st_mode):
                raise EnvironmentalError(f"{file}: a password is kept in a regular file")
            return opened.readline(_MAX_SIZE).rstrip(b"\r\n")
    except OSError as exc:
        raise EnvironmentalError(f"{file}: {exc.strerror or exc}") from None


def read_password_text(file: Path) -> str:
    """Return the first line of *file* as text; raise EnvironmentalError also if it is not UTF-8."""
    try:
        return read_password(file).decode()
    except UnicodeDecodeError:
        raise EnvironmentalError(f"{file}: its first line is not UTF-8") from None
