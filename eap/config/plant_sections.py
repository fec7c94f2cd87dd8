"""Top level of a plant file."""

from __future__ import annotations

import msgspec

from eap.config.structs import Defaults, PlantAccess, Section, StationSection, TypeSection
from eap.config.web_sections import MetricsSection, WebSection


class PlantFile(Section, frozen=True, kw_only=True):
    """The whole file; top-level keys that begin with ``x-`` are free for anchors."""

    plant: str
    stations: tuple[StationSection, ...]
    defaults: Defaults = Defaults()
    access: PlantAccess = PlantAccess()
    types: dict[str, TypeSection] | tuple[str | dict[str, TypeSection], ...] = msgspec.field(
        default_factory=dict
    )
    web: WebSection | None = None
    metrics: MetricsSection | None = None
