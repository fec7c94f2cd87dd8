"""Servers of optional processes: the addresses at which a plant file has them listen."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from eap.config.finding import FindingReport
from eap.config.index import Index
from eap.config.listen import Listen, parse_listen
from eap.config.plant_sections import PlantFile


class Server(NamedTuple):
    """Server of an optional process.

    Attributes:
        name: Its key in the plant file, as in messages.
        at: Place of its address in the plant file.
        listen: The address.
    """

    name: str
    at: str
    listen: Listen


def find_servers(plant: PlantFile) -> Iterator[Server]:
    """Yield the servers of *plant*; those whose address is none have findings of their own."""
    sections = {
        "web": plant.web,
        "metrics": plant.metrics,
        "opcua": plant.opcua,
        "s7": None if plant.s7 is None else plant.s7.server,
        "modbus": None if plant.modbus is None else plant.modbus.server,
    }
    for name, section in sections.items():
        if section is not None:
            try:
                yield Server(name, f"{section.at}.listen", parse_listen(section.listen))
            except ValueError:
                continue


def check_servers(index: Index, report: FindingReport) -> None:
    """Report servers whose address is that of another one."""
    found: list[Server] = []
    for server in find_servers(index.plant):
        for other in found:
            if _meet(server.listen, other.listen):
                message = f"{server.name} listens at the address of {other.name}"
                expected = "another port"
                if (other.name, server.name) == ("web", "metrics"):
                    expected += ", or no such key: the page gives metrics, too"
                report.add(server.at, message, expected)
        found.append(server)


def _meet(one: Listen, other: Listen) -> bool:
    is_wide = one.is_any or other.is_any
    return one.port == other.port and (is_wide or one.host == other.host)
