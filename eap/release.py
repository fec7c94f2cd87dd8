"""Release of this software; pyproject.toml takes it from here.

The metadata of the installed package say the same, but reading them takes longer than a process of
an appliance takes to start otherwise.
"""

from __future__ import annotations

RELEASE = "0.1.0"
