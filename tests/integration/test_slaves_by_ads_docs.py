"""docs/slaves-by-ads.md tells the truth: its examples run on the demo plant."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.appliance import Plants, wait_until
from tests.support.pages import run_examples

pytest.importorskip("pyads", reason="needs pyads: pip install pyads")

pytestmark = pytest.mark.net

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "slaves-by-ads.md"


def test_examples(farm: Plants) -> None:
    demo = farm.run(ROOT / "config" / "demo.yaml")
    state = {"bus0.state": 8}
    wait_until(lambda: demo.request("read", station="island-01", names=[*state])["values"] == state)
    run_examples(PAGE, at_least=30)
