"""docs/ads.md tells the truth: its examples run on the demo plant."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.appliance import Plants
from tests.support.pages import run_examples

pytest.importorskip("pyads", reason="needs pyads: pip install pyads")

pytestmark = pytest.mark.net

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "ads.md"


def test_examples(farm: Plants) -> None:
    farm.run(ROOT / "config" / "demo.yaml")
    run_examples(PAGE, at_least=25)
