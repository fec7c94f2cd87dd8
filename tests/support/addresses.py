"""Loopback addresses that belong to one test process, whoever else tests on this machine."""

from __future__ import annotations

import os


def own_address(number: int) -> str:
    """Return address *number* (0 to 2) of this process, in 127.128.0.0/9."""
    low = os.getpid() << 2 | number
    return f"127.{0x80 | low >> 16 & 0x7F}.{low >> 8 & 0xFF}.{low & 0xFF}"
