"""What the tests of several drivers share."""

from __future__ import annotations

import ctypes
import os
import subprocess
from pathlib import Path

import pytest

CLONE_NEWNET = 0x40000000


def ip(command):
    """Run ``ip`` in the network namespace of this thread."""
    subprocess.run(["ip", *command.split()], check=True, capture_output=True)


@pytest.fixture
def cable():
    """Two joined Ethernet interfaces, ``left`` and ``right``, in a network of their own."""
    library = ctypes.CDLL(None, use_errno=True)
    with Path("/proc/thread-self/ns/net").open("rb") as home:
        if library.unshare(CLONE_NEWNET):
            pytest.skip(f"no network namespace: {os.strerror(ctypes.get_errno())}")
        try:
            ip("link set lo up")
            ip("link add left type veth peer name right")
            ip("link set left up")
            ip("link set right up")
            yield "left", "right"
        finally:
            library.setns(home.fileno(), CLONE_NEWNET)
