"""Loading of plant files with the buses that they name, for all programs."""

from __future__ import annotations

from pathlib import Path

from eap.config.finding import PlantFinding
from eap.config.index import ExpectedBus
from eap.config.load import PlantResult, load


def load_plant(path: Path, folder: Path | None = None) -> PlantResult:
    """Read, check and complete the plant file at *path* and the bus files that it names.

    The files of the plant are in *folder* where it runs, by default in that of *path*.
    """
    return load(path, _describe, folder)


def _describe(path: Path) -> ExpectedBus | tuple[PlantFinding, ...]:
    from eap.runtime.busfile import describe  # simulated devices, when a plant has a bus

    return describe(path)
