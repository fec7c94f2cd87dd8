"""Files of other tools as ``eapctl import`` takes them: raw, and valid ones with values changed."""

from __future__ import annotations

import tempfile
from pathlib import Path

from eap.ops.imported_buses import SIMULATED
from eap.ops.imports import ImportChoices, run_import
from tools.fuzz.xmltexts import changed_values

_EXAMPLES = Path(__file__).parents[3] / "docs" / "examples"
_FILES = tuple((_EXAMPLES / name).read_bytes() for name in ("Line.tsproj", "Cell.xml"))
_CHOICES = ImportChoices(address="127.0.9.{n}", bus=SIMULATED)


def fuzz_one(data: bytes) -> None:
    """A plant is made that is without findings, or the report says why there is none."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "Line.tsproj")
        for content in (data, changed_values(_FILES[len(data) % len(_FILES)], data)):
            path.write_bytes(content)
            result, text = run_import([path], None, _CHOICES)
            if result.ok != bool(text) or (not result.ok and not result.findings):
                raise AssertionError(f"{result.ok} without a plant or a reason")
