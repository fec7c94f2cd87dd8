"""EtherCAT Automation Protocol (ETG.1005) appliance; docs/architecture.md draws its structure.

User programs need one name: ``eap.attach("station")`` gives the variables of a running station.
"""

from __future__ import annotations

TYPE_CHECKING = False  # as in typing, which a child process has no time to import first
if TYPE_CHECKING:
    from eap.runtime.attach import AttachedStation

__all__ = ["attach"]


def attach(station: str, *, plant: str = "") -> AttachedStation:
    """Attach to the running station of that name; see :mod:`eap.runtime.attach`."""
    from eap.runtime.attach import attach as attach_station  # the engine must not load it

    return attach_station(station, plant=plant)
