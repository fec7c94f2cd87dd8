"""ESI files of vendors on disk: single files, and folders with a cached list of their devices.

A folder such as that of TwinCAT has a hundred files and thousands of devices.  The list of a file
is kept with its size and time of change, so that only changed files are read again.
"""

from __future__ import annotations

import logging
import os
import stat
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec

from devicebus.esi.choice import DeviceQuery, choose_devices, match_slave
from devicebus.esi.content import (
    ROOT,
    DeviceResult,
    EsiList,
    ListedDevice,
    list_devices,
    load_device,
)
from devicebus.esi.fields import EsiFinding
from devicebus.esi.records import EsiDevice
from eap.config.finding import PlantFinding
from eap.errors import ConfigError
from eap.runtime import durable
from eap.runtime.store import state_root

logger = logging.getLogger(__name__)

MAX_FILES = 10_000
"""Files of a folder; further ones are not read."""
MAX_DEPTH = 4
MAX_FOLDERS = 2000
_VERSION = 1


class LocatedDevice(NamedTuple):
    """Device in the list of a file."""

    file: Path
    listed: ListedDevice


class FoundDevice(NamedTuple):
    """Device that was chosen; None with the reasons if it cannot be used."""

    located: LocatedDevice
    device: EsiDevice | None
    findings: tuple[PlantFinding, ...] = ()


class _ListedFile(msgspec.Struct, frozen=True):
    """A file with the size and time of its last change for which the list is true."""

    size: int
    changed_ns: int
    content: EsiList


class EsiSource:
    """Devices of an ESI file, or of all ESI files of a folder.

    Args:
        path: File or folder.

    Attributes:
        is_folder: True for a folder.

    Raises:
        OSError: *path* cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.is_folder = path.is_dir()
        files = _list_folder(path) if self.is_folder else {path: _read_list(path)}
        self._files = files
        self._devices = [
            LocatedDevice(file, listed)
            for file, content in files.items()
            for listed in content.devices
        ]
        self._loaded: dict[tuple[Path, int], DeviceResult] = {}

    @property
    def devices(self) -> Sequence[LocatedDevice]:
        """All devices."""
        return self._devices

    def findings(self) -> Iterator[PlantFinding]:
        """Yield the faults of files whose devices could not all be listed."""
        for file, content in self._files.items():
            yield from _findings(file, content.findings)

    @property
    def no_device(self) -> PlantFinding:
        """Finding for a source without devices."""
        message = "it describes no device"
        expected = "an ESI file with devices, or a folder of such files"
        return PlantFinding(str(self.path), 0, "", message, expected)

    def choose(self, query: DeviceQuery) -> FoundDevice:
        """Return the device that a configuration names.

        Without a revision it is the highest one that can be used.

        Raises:
            ValueError: there is none; the message names the source.
        """
        if not self.is_folder and query == DeviceQuery() and self._devices:
            return self._first(self._devices[:1])
        try:
            chosen = choose_devices((each.listed for each in self._devices), query)
        except ValueError as exc:
            bad = sum(bool(content.findings) for content in self._files.values())
            have = "has" if bad == 1 else "have"
            hint = f" ({bad} of its files {have} faults)" if bad else ""
            raise ValueError(f"{self.path.name}: {exc}{hint}") from None
        return self._first(map(self._located, chosen))

    def match(self, query: DeviceQuery) -> FoundDevice | None:
        """Return the best description of a slave that can be used, None without one."""
        matched = match_slave((each.listed for each in self._devices), query)
        return self._first(map(self._located, matched)) if matched else None

    def _first(self, candidates: Iterable[LocatedDevice]) -> FoundDevice:
        """Return the first device that can be used, else the first one with its faults."""
        failed = None
        for located in candidates:
            result = self.load(located)
            if isinstance(result, EsiDevice):
                return FoundDevice(located, result)
            failed = failed or FoundDevice(located, None, result)
        assert failed is not None  # noqa: S101  there is a candidate
        return failed

    def load(self, located: LocatedDevice) -> EsiDevice | tuple[PlantFinding, ...]:
        """Return a device, or the reasons that it cannot be used."""
        key = located.file, located.listed.number
        if key not in self._loaded:
            try:
                with located.file.open("rb") as stream:
                    self._loaded[key] = load_device(stream, located.listed)
            except OSError as exc:
                fault = EsiFinding(0, f"it cannot be read: {exc.strerror}", "the file as it was")
                self._loaded[key] = DeviceResult(None, (fault,))
        result = self._loaded[key]
        if result.device is not None:
            return result.device
        return tuple(_findings(located.file, result.findings))

    def _located(self, listed: ListedDevice) -> LocatedDevice:
        return next(each for each in self._devices if each.listed is listed)


def _findings(file: Path, findings: Sequence[EsiFinding]) -> Iterator[PlantFinding]:
    for each in findings:
        yield PlantFinding(str(file), each.line, "", each.message, each.expected)


def _read_list(path: Path) -> EsiList:
    if not path.is_file():
        # A pipe would wait for a writer.
        raise OSError(0, "is no regular file" if path.exists() else "does not exist")
    with path.open("rb") as stream:
        return list_devices(stream)


def _list_folder(folder: Path) -> dict[Path, EsiList]:
    """Return the lists of all ESI files below *folder*, from the cache where it is true."""
    cache = _cache_of(folder)
    known = _read_cache(cache)
    fresh: dict[str, _ListedFile] = {}
    for path, status in _files(folder):
        name = str(path.relative_to(folder))
        kept = known.get(name)
        if kept is None or (kept.size, kept.changed_ns) != (status.st_size, status.st_mtime_ns):
            kept = _ListedFile(status.st_size, status.st_mtime_ns, _list_file(path))
        fresh[name] = kept
    if fresh != known:
        _write_cache(cache, fresh)
    return {folder / name: each.content for name, each in fresh.items()}


def _list_file(path: Path) -> EsiList:
    try:
        found = _read_list(path)
    except OSError as exc:
        return EsiList(findings=(EsiFinding(0, f"it cannot be read: {exc.strerror}", "a file"),))
    # Dictionaries and texts of diagnosis lie in the same folders, and are no faults.
    if not found.devices and any(each.expected == ROOT for each in found.findings):
        return EsiList()
    return found


def _files(folder: Path) -> Iterator[tuple[Path, os.stat_result]]:
    """Yield the XML files below *folder* in order, with their status; raise OSError."""
    count = folders = 0
    left = [(each, 1) for each in reversed(_entries(folder))]
    while left and count < MAX_FILES and folders < MAX_FOLDERS:
        entry, depth = left.pop()
        try:
            if entry.is_dir():
                folders += 1
                if depth < MAX_DEPTH:
                    left += [(each, depth + 1) for each in reversed(_entries(Path(entry.path)))]
            elif entry.name.lower().endswith(".xml"):
                status = entry.stat()
                if stat.S_ISREG(status.st_mode):
                    count += 1
                    yield Path(entry.path), status
        except OSError:
            continue  # gone meanwhile, or a folder of somebody else


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    with os.scandir(folder) as entries:
        return sorted(entries, key=lambda each: each.name)


def _cache_of(folder: Path) -> Path:
    name = durable.digest(str(folder.resolve()).encode())[:32]
    return state_root() / "esi" / f"{name}.json"


def _read_cache(path: Path) -> dict[str, _ListedFile]:
    try:
        content = durable.unseal(path.read_bytes(), _VERSION)
        return msgspec.json.decode(content, type=dict[str, _ListedFile])
    except (OSError, ConfigError, ValueError):
        return {}


def _write_cache(path: Path, files: dict[str, _ListedFile]) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        durable.replace_file(path, durable.seal(msgspec.json.encode(files), _VERSION))
    except OSError as exc:
        logger.debug("the list of ESI files is not kept: %s: %s", path, exc.strerror)
