"""Fixtures of the tests of several drivers."""

from __future__ import annotations

import ctypes
import os
import subprocess
import time
from pathlib import Path

import pytest

from eap.net import interface
from eap.net.interface import link_is_up

CLONE_NEWNET = 0x40000000


def ip(command):
    """Run ``ip`` in the network namespace of this thread."""
    subprocess.run(["ip", *command.split()], check=True, capture_output=True)


def wait_for_links(*names):
    limit = time.monotonic() + 5
    while not all(link_is_up(name) for name in names):
        assert time.monotonic() < limit


def forget_kernel_socket():
    """Have questions about interfaces asked in the namespace of now; a process has only one."""
    interface._kernel().close()
    interface._kernel.cache_clear()


@pytest.fixture
def cable():
    """Two joined Ethernet interfaces, ``left`` and ``right``, in a network of their own."""
    library = ctypes.CDLL(None, use_errno=True)
    with Path("/proc/thread-self/ns/net").open("rb") as home:
        if library.unshare(CLONE_NEWNET):
            pytest.skip(f"no network namespace: {os.strerror(ctypes.get_errno())}")
        forget_kernel_socket()
        try:
            ip("link set lo up")
            ip("link add left type veth peer name right")
            ip("link set left up")
            ip("link set right up")
            wait_for_links("left", "right")  # until then the kernel drops what is sent
            yield "left", "right"
        finally:
            library.setns(home.fileno(), CLONE_NEWNET)
            forget_kernel_socket()
