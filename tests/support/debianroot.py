"""A clean Debian in a folder, with systemd as its first process: no root of this machine changes.

The tree is made once by debootstrap and kept as an archive in the user's cache.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

import pytest

from eap.closeable import Closeable

_PACKAGES = "adduser,iproute2,logrotate,openssh-server,python3,systemd"
# A control group of its own: the systemd of this machine, and others in tests, have theirs.
_BEGIN = """
set -e
mount -t cgroup2 none mnt
mkdir mnt/eap-test-$$
echo $$ > mnt/eap-test-$$/cgroup.procs
umount mnt
exec unshare --mount --net --uts --ipc --cgroup --pid --fork --kill-child sh -c "$0"
"""
_BOOT = """
set -e
mount --bind "$PWD" "$PWD" && cd "$PWD"
mount -t proc proc proc
mount -t sysfs sysfs sys
mount -t tmpfs tmpfs run
mount -t tmpfs tmpfs tmp
mkdir -p dev/pts dev/shm && mount -t devpts devpts dev/pts
mountpoint -q sys/fs/cgroup && umount -l sys/fs/cgroup
mount -t cgroup2 none sys/fs/cgroup
ip link set lo up
container=test exec chroot . /lib/systemd/systemd --unit=multi-user.target
"""
_END = """
mount -t cgroup2 none mnt
for attempt in 1 2 3 4 5 6 7 8 9 10; do  # killed processes take a moment to end
    find mnt/eap-test-$0 -depth -type d -exec rmdir {} + 2>/dev/null && break
    sleep 0.2
done
"""
_BOOT_S = 120


def archive() -> Path:
    """Return the archive of a clean Debian; make it the first time.

    The test is skipped where that is not possible.
    """
    if os.geteuid() != 0:
        pytest.skip("needs root (chroot, namespaces); run make test-package as root")
    if shutil.which("debootstrap") is None:
        pytest.skip("needs debootstrap; to install: apt-get install debootstrap")
    release = dict(
        line.split("=", 1) for line in Path("/etc/os-release").read_text().splitlines() if line
    )
    suite = release.get("VERSION_CODENAME", "").strip('"')
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "eap-appliance"
    found = cache / f"debian-{suite}-{_PACKAGES.replace(',', '-')}.tar"
    if not found.exists():
        _make(found, suite)
    return found


def _make(target: Path, suite: str) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    folder = target.with_suffix(f".{os.getpid()}")
    listed = ["apt-get", "indextargets", "--format", "$(REPO_URI)", "Created-By: Packages"]
    mirrors = subprocess.run(listed, capture_output=True, text=True, check=False).stdout.split()
    command = ["debootstrap", "--variant=minbase", f"--include={_PACKAGES}", suite, str(folder)]
    try:
        done = subprocess.run(
            [*command, *mirrors[:1]], capture_output=True, text=True, check=False, timeout=900
        )
        if done.returncode:
            pytest.skip(f"debootstrap failed: {(done.stderr or done.stdout).strip()[-200:]}")
        partial = target.with_suffix(".partial")
        subprocess.run(["tar", "-C", str(folder), "-cf", str(partial), "."], check=True)
        partial.replace(target)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


class DebianRoot(Closeable):
    """The Debian in *folder*, booted; it ends with ``close``."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        subprocess.run(["tar", "-C", str(folder), "-xf", str(archive())], check=True)
        # No login is waited for, and no name is looked up.
        for unit in ("getty.target", "systemd-resolved.service", "systemd-networkd.service"):
            (folder / "etc/systemd/system" / unit).symlink_to("/dev/null")
        self._holder = subprocess.Popen(
            ["unshare", "--mount", "sh", "-c", _BEGIN, _BOOT],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    def wait_booted(self) -> Self:
        """Wait until systemd runs; skip the test where it cannot."""
        deadline_s = time.monotonic() + _BOOT_S
        while True:
            done = self.attempt("systemctl is-system-running")
            if done.stdout.strip() in {"running", "degraded"}:
                return self
            if self._holder.poll() is not None or time.monotonic() > deadline_s:
                self._holder.kill()
                reason = self._holder.communicate()[1].strip() or done.stdout + done.stderr
                pytest.skip(f"systemd does not start in a namespace here: {reason[-300:]}")
            time.sleep(0.2)

    @property
    def pid(self) -> int:
        """Process of systemd, as this machine numbers it; 0 if there is none yet."""
        children = Path(f"/proc/{self._holder.pid}/task/{self._holder.pid}/children")
        found = children.read_text().split() if children.exists() else []
        return int(found[0]) if found else 0

    def attempt(self, command: str) -> subprocess.CompletedProcess[str]:
        """Run a shell command as root, in an environment as after a login."""
        pid = self.pid
        if not pid:
            return subprocess.CompletedProcess(command, 1, "", "no process yet")
        enter = ["nsenter", "--target", str(pid), "--mount", "--net", "--pid", "--ipc", "--uts"]
        path = "PATH=/usr/sbin:/usr/bin:/sbin:/bin"
        return subprocess.run(
            [*enter, "--root", "--wd", "env", "-i", path, "sh", "-c", command],
            capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL, timeout=600,
        )  # fmt: skip

    def run(self, command: str) -> str:
        """Return the output of a command that succeeds."""
        done = self.attempt(command)
        assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
        return done.stdout

    def wait_for(
        self, command: str, is_right: Callable[[str], object], timeout_s: float = 120
    ) -> None:
        """Wait until the output of a command *is_right*."""
        deadline_s = time.monotonic() + timeout_s
        while not is_right(text := self.attempt(command).stdout):
            assert time.monotonic() < deadline_s, f"{command}: {text}"
            time.sleep(0.2)

    def files(self) -> set[str]:
        """Return the paths of all files and folders that a package might leave."""
        places = "/etc /usr /var /opt /home /root /srv"
        return set(self.run(f"find {places} -xdev").splitlines())

    def close(self) -> None:
        """End all processes."""
        self._holder.kill()
        self._holder.communicate()
        subprocess.run(
            ["unshare", "--mount", "sh", "-c", _END, str(self._holder.pid)],
            cwd=self.folder, check=False, stdin=subprocess.DEVNULL,
        )  # fmt: skip
