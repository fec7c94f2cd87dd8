"""Status of several appliances as one document."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import msgspec

VERSION = 1
"""Of the format."""


class ApplianceStatus(msgspec.Struct, frozen=True):
    """Status of one appliance, without its stations."""

    plant: str
    stations: list[str]
    processes: dict[str, Any]
    findings: list[dict[str, Any]] = []
    audit: dict[str, Any] | None = None
    listeners: list[dict[str, Any]] = []
    release: str = ""
    host: str = ""
    hosts: list[dict[str, Any]] = []
    logins: dict[str, dict[str, int]] = {}


class SilentAppliance(msgspec.Struct, frozen=True):
    """Appliance that does not answer: its plant, stations, and the process id of its services."""

    plant: str
    stations: list[str]
    services: int


class MergedStatus(msgspec.Struct, frozen=True):
    """Status of several appliances.

    Attributes:
        version: Of the format.
        processes: Those of the first appliance.
        stations: Of all appliances that answer, each with the name of its plant.
        appliances: All appliances that answer.
        silent: Appliances that do not answer.
    """

    version: int
    processes: dict[str, Any]
    stations: list[dict[str, Any]]
    appliances: list[ApplianceStatus]
    silent: list[SilentAppliance] = []

    @classmethod
    def of(cls, answers: Sequence[dict[str, Any]], silent: Sequence[SilentAppliance] = ()) -> Self:
        """Merge the answers of appliances to the method ``status``."""
        appliances = [
            msgspec.convert(
                answer | {"stations": [station["name"] for station in answer["stations"]]},
                ApplianceStatus,
            )
            for answer in answers
        ]
        stations = [
            {"plant": answer["plant"], **station}
            for answer in answers
            for station in answer["stations"]
        ]
        return cls(
            answers[0]["version"] if answers else VERSION,
            answers[0]["processes"] if answers else {},
            stations,
            appliances,
            list(silent),
        )
