"""docs/ads.md tells the truth: its examples run on the demo plant."""

from __future__ import annotations

import doctest
from pathlib import Path

import pytest

from tests.support.appliance import Plants

pytest.importorskip("pyads", reason="needs pyads: pip install pyads")

pytestmark = pytest.mark.net

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "ads.md"


def test_examples(farm: Plants) -> None:
    farm.run(ROOT / "config" / "demo.yaml")
    test = doctest.DocTestParser().get_doctest(PAGE.read_text(), {}, PAGE.name, PAGE.name, 0)
    told: list[str] = []
    result = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test, out=told.append)
    assert result.attempted > 25
    assert not result.failed, "".join(told)
