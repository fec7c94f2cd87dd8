"""Ansible inventory of the hosts of a plant file.

The form is that of Ansible's inventory scripts: groups with ``hosts``, ``vars`` and ``children``,
and in ``_meta`` the variables of all hosts, so that Ansible calls the script once.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from eap.config.load import Plant
from eap.config.plant_sections import HostSection
from eap.errors import ConfigError
from eap.suggest import suggest

GROUP = "eap"
"""Group of all hosts, of every plant."""
_NO_NAME = re.compile(r"\W", re.ASCII)


def group_of(plant: str) -> str:
    """Return the group of the hosts of *plant*; group names have letters, digits and ``_``."""
    return f"{GROUP}_{_NO_NAME.sub('_', plant)}"


def inventory(plant: Plant, file: Path) -> dict[str, Any]:
    """Return the inventory of *plant*, which *file* describes, as Ansible reads it.

    Raises:
        ConfigError: the plant has no hosts.
    """
    group = group_of(plant.name)
    hosts = _hosts(plant)
    return {
        "_meta": {"hostvars": {host.name: _variables(host) for host in hosts}},
        "all": {"children": [GROUP]},
        GROUP: {"children": [group]},
        group: {
            "hosts": [host.name for host in hosts],
            "vars": {"eap_plant": plant.name, "eap_plant_file": str(file.resolve())},
        },
    }


def host_variables(plant: Plant, name: str) -> dict[str, Any]:
    """Return the variables of one host; raise ConfigError if the plant has no such host."""
    known = {host.name: host for host in _hosts(plant)}
    if name not in known:
        hint = suggest(name, known) or f": it has {', '.join(known)}"
        raise ConfigError(f"plant {plant.name} has no host {name!r}{hint}")
    return _variables(known[name])


def _hosts(plant: Plant) -> tuple[HostSection, ...]:
    if not plant.hosts:
        raise ConfigError(
            f"plant {plant.name} has no hosts: name them with their stations in hosts: of its file"
        )
    return plant.hosts


def _variables(host: HostSection) -> dict[str, Any]:
    login = {"ansible_user": host.user} if host.user else {}
    own = {"eap_host": host.name, "eap_stations": list(host.stations)}
    return {"ansible_host": host.address, **login, **own}
