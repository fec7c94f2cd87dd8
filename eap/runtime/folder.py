"""The runtime directory: one folder per running appliance, in which clients find it.

A folder is alive exactly as long as its supervisor holds the lock in it.  The kernel drops that
lock however the supervisor ends, so no process id has to be interpreted.
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import pwd
import shutil
import socket
import stat
import struct
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import msgspec

from eap.closeable import Closeable
from eap.errors import EnvironmentalError

VARIABLE = "EAP_RUNTIME_DIR"
SYSTEM_ROOT = Path("/run/eap")
FALLBACK_PARENT = Path("/tmp")  # noqa: S108  the folder in it is private, see _require_private
MAX_SOCKET_PATH = 107
"""Bytes of a Unix socket's path (``sun_path`` less its final zero)."""

_FLOCK = struct.Struct("hhqqi4x")
_MAX_NAME = 60

logger = logging.getLogger(__name__)


class ProcessInfo(msgspec.Struct):
    """One process of an appliance; *pid* is 0 while it is being started again."""

    pid: int = 0
    restarts: int = 0
    report: dict[str, Any] = {}
    """Report of the process when it became ready."""
    step: str = ""
    """Step of its start-up; empty when it runs."""
    fault: str = ""
    """Reason that an optional process does not run."""


class ApplianceInfo(msgspec.Struct):
    """Description of an appliance by its supervisor (``appliance.json``)."""

    plant: str
    plant_file: str
    stations: list[str]
    started_at: str
    """Wall clock, ISO 8601 with time zone."""
    supervisor: int
    """Process id."""
    engine: ProcessInfo = msgspec.field(default_factory=ProcessInfo)
    services: ProcessInfo = msgspec.field(default_factory=ProcessInfo)
    segments: dict[str, ProcessInfo] = {}
    """Simulated buses by ``STATION/PORT``."""
    extras: dict[str, ProcessInfo] = {}
    """Optional processes, such as ``web``."""
    audit_required: bool = False
    """True if changes that cannot be recorded fail."""
    host: str = ""
    """Host of the plant that this computer is; empty without ``hosts``."""
    sections: dict[str, str] | None = None
    """Digests of the plant file's sections for optional processes; None from older releases."""


def runtime_root() -> Path:
    """Return the directory in which this user's appliances have their folders.

    EAP_RUNTIME_DIR, else the first that can be written of ``$XDG_RUNTIME_DIR/eap``, ``/run/eap``
    and the user's private folder ``/tmp/eap-UID``.
    """
    *preferred, last = runtime_roots()
    return next(filter(_can_be_written, preferred), last)


def runtime_roots() -> list[Path]:
    """Return all directories in which appliances of this user may have their folders."""
    if given := os.environ.get(VARIABLE):
        return [Path(given)]
    session = os.environ.get("XDG_RUNTIME_DIR")
    roots = [Path(session) / "eap"] if session else []
    return list(dict.fromkeys((*roots, SYSTEM_ROOT, _private_root())))


def describe_roots() -> str:
    """Return the directories that are searched for appliances, as text."""
    return ", ".join(map(str, runtime_roots()))


def _private_root() -> Path:
    return FALLBACK_PARENT / f"eap-{os.geteuid()}"


def _can_be_written(path: Path) -> bool:
    """Return whether *path* is a directory in which this user may make files, or can become one."""
    target = path if os.path.exists(path) else path.parent  # noqa: PTH110  never raises
    return os.access(target, os.W_OK | os.X_OK, effective_ids=True)


def _require_private(path: Path) -> None:
    """Make *path*, or check that it is a directory which no other user can have touched.

    Any user may make files in its parent, so another user can be first.

    Raises:
        EnvironmentalError: it is a symbolic link or no directory, or other users own or enter it.
    """
    try:
        path.mkdir(mode=0o700, exist_ok=True)
        # lstat, and after mkdir: a link that another user put there would lead to that user's
        # folder.
        found = path.lstat()
    except OSError as exc:
        reason = exc.strerror
        if isinstance(exc, FileExistsError):
            reason = "it is no directory"
        raise _unsafe(path, str(reason)) from None
    if stat.S_ISLNK(found.st_mode):
        raise _unsafe(path, "it is a symbolic link")
    if found.st_uid != os.geteuid():
        raise _unsafe(path, f"it belongs to {_user_name(found.st_uid)}")
    if mode := stat.S_IMODE(found.st_mode) & 0o077:
        raise _unsafe(path, f"other users have rights in it (mode {mode:03o})")


def _unsafe(path: Path, reason: str) -> EnvironmentalError:
    return EnvironmentalError(
        f"runtime directory {path} cannot be used: {reason}; remove it, or set {VARIABLE} to a"
        f" directory that only you may write"
    )


def _user_name(uid: int) -> str:
    try:
        return f"user {pwd.getpwuid(uid).pw_name}"
    except KeyError:
        return f"user {uid}"


def folder_name(plant: str, subset: Sequence[str] = ()) -> str:
    """Return the folder of *plant*, or of the *subset* of its stations that an appliance runs."""
    name = f"{plant}@{'+'.join(subset)}" if subset else plant
    safe = "".join(c if c.isalnum() or c in "-_.@+" else "_" for c in name)
    # A digest where characters were replaced: two names that differ in them only need two folders.
    if safe == name and len(name) <= _MAX_NAME and not name.startswith("."):
        return name
    digest = hashlib.sha256(name.encode()).hexdigest()[:8]
    return f"{safe[:_MAX_NAME].lstrip('.')}-{digest}"


class ApplianceFolder(Closeable):
    """The paths of one appliance's folder; its supervisor holds the lock until ``close``."""

    def __init__(self, path: Path, lock_fd: int = -1) -> None:
        self.path = path
        self._lock_fd = lock_fd
        self._folder_fd = -1
        self._is_shared = False

    @classmethod
    def claim(cls, name: str) -> Self:
        """Make the folder *name* ours and empty.

        Raises:
            EnvironmentalError: another process holds it, it holds other files, or the
                directory cannot be written.
        """
        root = runtime_root()
        if root == _private_root() and not os.environ.get(VARIABLE):
            _require_private(root)
            logger.warning(
                "runtime directory is %s: there is no session directory (XDG_RUNTIME_DIR), and %s"
                " cannot be written",
                root,
                SYSTEM_ROOT,
            )
        path = root / name
        if _holds_other_files(path):
            raise EnvironmentalError(
                f"runtime directory {path} is no folder of an appliance, and would be emptied: set"
                f" {VARIABLE} to a directory that holds nothing else"
            )
        try:
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
            path.chmod(0o700)  # an appliance that was killed may have shared it
            lock_fd = _lock(path)
        except OSError as exc:
            raise EnvironmentalError(
                f"runtime directory {path}: {exc.strerror}; set {VARIABLE} to a directory that"
                f" you may write"
            ) from None
        folder = cls(path, lock_fd)
        if len(os.fsencode(folder.control_socket)) > MAX_SOCKET_PATH:
            folder.close()
            raise EnvironmentalError(
                f"runtime directory {path} is too long for a socket's path (at most"
                f" {MAX_SOCKET_PATH} bytes): set {VARIABLE} to a shorter one"
            )
        folder._empty()
        folder._keep_from_ageing()
        return folder

    def share(self) -> None:
        """Let other users of the host find the appliance and reach its control socket.

        The umask of this process and its children closes all other files in the folder to them.
        """
        self._is_shared = True
        os.umask(0o077)
        self.path.chmod(0o711)
        if not self.path.parent.stat().st_mode & 0o011:
            logger.warning(
                "users of the plant file cannot reach the control socket: other users may not enter"
                " %s",
                self.path.parent,
            )

    @property
    def control_socket(self) -> Path:
        """Path of the control socket."""
        return self.path / "control"

    @property
    def bytecode(self) -> Path:
        """Folder for bytecode of modules, where Python keeps none."""
        return self.path / "bytecode"

    def discards(self, process: str) -> Path:
        """Return the file of the drop counters of *process*."""
        return self.path / f"{process}.discards"

    @property
    def frames(self) -> Path:
        """File of the ring of recorded frames."""
        return self.path / "frames.ring"

    def segment(self, digest: str) -> Path:
        """Return the file of the simulated slaves with *digest*."""
        return self.path / f"{digest}.slaves"

    def image(self, station: str) -> Path:
        """Return the file of one station's process image."""
        return self.path / f"{folder_name(station)}.image"

    def write_info(self, info: ApplianceInfo) -> None:
        """Replace ``appliance.json`` in one step."""
        temporary = self.path / "appliance.json.new"
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(info)))
        if self._is_shared:
            temporary.chmod(0o644)
        temporary.replace(self.path / "appliance.json")

    def read_info(self) -> ApplianceInfo:
        """Return what the supervisor wrote last; raise OSError when there is nothing yet."""
        return msgspec.json.decode((self.path / "appliance.json").read_bytes(), type=ApplianceInfo)

    def is_alive(self) -> bool:
        """Return whether a supervisor holds the lock; the check never disturbs a start."""
        try:
            fd = os.open(self.path / "lock", os.O_RDWR | os.O_CLOEXEC)
        except PermissionError:
            return self._answers()
        except OSError:
            return False
        try:
            request = _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0)
            # Tests the lock without taking it, so that a start at the same moment succeeds.
            answer = fcntl.fcntl(fd, fcntl.F_OFD_GETLK, request)
        finally:
            os.close(fd)
        return bool(_FLOCK.unpack(answer)[0] != fcntl.F_UNLCK)

    def _answers(self) -> bool:
        """Return whether the control socket of another user's appliance can be connected."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            probe.setblocking(False)
            return probe.connect_ex(str(self.control_socket)) == 0

    def close(self) -> None:
        """Remove the folder and let go of the lock."""
        if self._lock_fd < 0:
            return
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self._lock_fd)
        self._lock_fd = -1
        if self._folder_fd >= 0:
            os.close(self._folder_fd)

    def _keep_from_ageing(self) -> None:
        """Lock the folder: systemd-tmpfiles removes what is old in /tmp, but not behind a lock."""
        self._folder_fd = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        fcntl.flock(self._folder_fd, fcntl.LOCK_SH)

    def _empty(self) -> None:
        for entry in self.path.iterdir():
            if entry == self.bytecode:
                shutil.rmtree(entry)
            # The lock stays: a file removed under it would let another process lock its own.
            elif entry.name != "lock":
                entry.unlink()


def find_appliances() -> list[ApplianceFolder]:
    """Return the folders of all running appliances, by name."""
    folders: list[Path] = []
    for root in runtime_roots():
        with suppress(OSError):
            if root != _private_root() or root.lstat().st_uid == os.geteuid():
                folders += (entry for entry in root.iterdir() if entry.is_dir())
    ordered = sorted(folders, key=lambda path: path.name)
    return [folder for folder in map(ApplianceFolder, ordered) if folder.is_alive()]


def find_running() -> list[tuple[ApplianceFolder, ApplianceInfo]]:
    """Return all running appliances that can be reached, each with its description."""
    running = []
    for folder in find_appliances():
        try:
            running.append((folder, folder.read_info()))
        except (OSError, ValueError):
            continue  # it is starting or stopping, or of another release
    return running


def _holds_other_files(path: Path) -> bool:
    """Return whether *path* was not made by an appliance: its first file is always the lock."""
    try:
        return any(path.iterdir()) and not (path / "lock").exists()
    except OSError:
        return False  # it does not exist, or claiming it will say what is wrong


def take_lock(fd: int) -> None:
    """Lock a file until the last process that has *fd* ends; raise BlockingIOError if it is taken.

    :meth:`ApplianceFolder.is_alive` takes no lock, so it never prevents a start.
    """
    # An OFD lock: a POSIX one would be dropped when this process closes any descriptor of the file.
    fcntl.fcntl(fd, fcntl.F_OFD_SETLK, _FLOCK.pack(fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0))


def _lock(path: Path) -> int:
    """Take the lock of *path*; a folder removed by its last owner meanwhile is made again."""
    while True:
        fd = os.open(path / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            take_lock(fd)
        except BlockingIOError:
            holder = os.pread(fd, 16, 0).decode("ascii", "replace") or "another process"
            os.close(fd)
            raise EnvironmentalError(
                f"appliance {path.name} already runs (process {holder}); stop it first, or choose"
                f" other stations with --station"
            ) from None
        # The last owner may have removed the file between open and lock: the lock would be on a
        # file that no one finds any more.
        if _is_same_file(fd, path / "lock"):
            os.ftruncate(fd, 0)
            os.pwrite(fd, str(os.getpid()).encode(), 0)
            return fd
        os.close(fd)
        path.mkdir(mode=0o700, parents=True, exist_ok=True)


def _is_same_file(fd: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(fd), path.stat())
    except FileNotFoundError:
        return False
