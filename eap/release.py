"""Release of this software; pyproject.toml takes it from here.

The metadata of the installed package say the same, but reading them takes longer than a process of
an appliance takes to start otherwise.
"""

from __future__ import annotations

import re

RELEASE = "0.1.0"

_NUMBERS = re.compile(r"(\d+)\.(\d+)")


def are_neighbours(one: str, other: str) -> bool:
    """Return whether two releases work together: the same minor release, or the one beside it.

    The first release of a new major number is beside all of the one before.  Release candidates
    and development versions count as the release that they lead to; an unknown form does not.
    """
    found = [_NUMBERS.match(text) for text in (one, other)]
    if None in found:
        return one == other
    older, newer = sorted((int(each[1]), int(each[2])) for each in found if each)
    if older[0] == newer[0]:
        return newer[1] - older[1] <= 1
    return newer == (older[0] + 1, 0)
