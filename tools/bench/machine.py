"""The machine that a benchmark runs on: what it is, and what it tells about a process."""

from __future__ import annotations

import os
import platform
import shutil
import struct
import sysconfig
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from eap.compiled import cyclic
from tools.bench.figures import SkippedError

_PM_QOS = Path("/dev/cpu_dma_latency")
_RUNTIME_FOLDERS = ("/dev/shm", "/run", "/tmp")  # noqa: S108  the first in memory is taken


class ProcessSample:
    """Processor time and memory of one process at one moment."""

    def __init__(self, pid: int) -> None:
        tasks = Path(f"/proc/{pid}/task").iterdir()
        self.cpu_ns = sum(int((task / "schedstat").read_text().split()[0]) for task in tasks)
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        self.rss = pages * os.sysconf("SC_PAGE_SIZE")
        """Octets."""


def describe() -> str:
    """Return one line: processors, kernel, Python and its build, the compiled part, the load."""
    info = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    models = [line.partition(":")[2].strip() for line in info.splitlines() if "model name" in line]
    model = models[0] if models else platform.machine()
    virtual = ", virtual machine" if " hypervisor" in info else ""
    return (
        f"{os.cpu_count()} cores of {model}{virtual}; Linux {os.uname().release}; "
        f"{platform.python_implementation()} {platform.python_version()}, {_build()}; "
        f"cyclic path {'in Python' if cyclic is None else 'compiled'}; "
        f"load before the run {os.getloadavg()[0]:.1f}"
    )


def _build() -> str:
    """Return whether Python was built with optimisation by profile, and at link time."""
    options = sysconfig.get_config_var("CONFIG_ARGS") or ""
    flags = sysconfig.get_config_var("PY_CORE_CFLAGS") or ""
    if "--enable-optimizations" not in options and "-fprofile-use" not in flags:
        return "built without optimisation by profile"
    return "built with optimisation by profile" + " and at link time" * ("--with-lto" in options)


def require_root() -> None:
    """Raise SkippedError unless namespaces can be made."""
    if os.geteuid() != 0:
        raise SkippedError("needs root, for network namespaces")
    require_program("ip", "iproute2")


def require_cores() -> None:
    """Raise SkippedError unless two processes can have a core each."""
    if len(os.sched_getaffinity(0)) < 2:
        raise SkippedError("needs two cores")


def require_program(name: str, package: str) -> str:
    """Return the path of a program; raise SkippedError if it is not installed."""
    path = shutil.which(name, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")
    if path is None:
        raise SkippedError(f"needs {name} (Debian package {package})")
    return path


def cores() -> tuple[int, int]:
    """Return the two cores to pin to."""
    first, second, *_ = sorted(os.sched_getaffinity(0))
    return first, second


def memory_folder() -> str:
    """Return a folder for temporary files, in memory if there is one."""
    return next(folder for folder in _RUNTIME_FOLDERS if os.access(folder, os.W_OK))


@contextmanager
def pm_qos(*, on: bool) -> Iterator[None]:
    """Keep all processors out of idle states that take time to leave, while the block runs.

    Raises:
        SkippedError: this machine does not let us.
    """
    if not on:
        yield
        return
    try:
        fd = os.open(_PM_QOS, os.O_WRONLY)
    except OSError as error:
        raise SkippedError(f"{_PM_QOS}: {error.strerror}") from None
    try:
        os.write(fd, struct.pack("=i", 0))
        yield
    finally:
        os.close(fd)
