"""The limit of file descriptors."""

from __future__ import annotations

import os
import resource
import subprocess
import sys

import pytest

from eap.net import descriptors
from eap.net.descriptors import descriptor_reserve, raise_descriptor_limit, spare_descriptors


@pytest.mark.parametrize(
    ("limit", "reserve"), [(60, 15), (1024, 128), (resource.RLIM_INFINITY, 128)]
)
def test_reserve_is_a_quarter_of_a_small_limit(
    monkeypatch: pytest.MonkeyPatch, limit: int, reserve: int
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (limit, limit))
    assert descriptor_reserve() == reserve
    if limit == 60:
        assert [spare_descriptors(fd, reserve) for fd in (43, 44, 50)] == [1, 0, -6]


def test_raise_descriptor_limit_reaches_the_hard_limit_and_the_children() -> None:
    script = (
        "import resource, subprocess, sys\n"
        "from eap.net.descriptors import raise_descriptor_limit\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (50, 90))\n"
        "assert raise_descriptor_limit() == 90\n"
        "print(subprocess.check_output(['sh', '-c', 'ulimit -n']).decode().strip())\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    assert done.stdout.strip() == b"90"


def test_raise_descriptor_limit_without_permission_keeps_the_soft_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(1, os.strerror(1))

    monkeypatch.setattr(descriptors.resource, "getrlimit", lambda _: (7, 9))
    monkeypatch.setattr(descriptors.resource, "setrlimit", refuse)
    assert raise_descriptor_limit() == 7
