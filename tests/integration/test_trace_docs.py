"""docs/trace.md and the page of commands tell the truth about traces and scans of the demo."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from tests.support.appliance import Plants, run_eapctl, wait_until

pytestmark = pytest.mark.net

ROOT = Path(__file__).parents[2]
_EXAMPLE = re.compile(r"```console\n\$ eapctl ((?:trace|scan)\b[^\n]*)\n(.*?)```", re.DOTALL)
EXAMPLES = [
    example
    for page in ("trace.md", "commands.md")
    for example in _EXAMPLE.findall((ROOT / "docs" / page).read_text())
]


def plain(text: str) -> list[str]:
    """Return the lines without times, rules and spaces."""
    timeless = re.sub(r"\d+(\.\d+)? (µs|ms|s)\b", "TIME", text.replace("─", ""))
    return [" ".join(line.split()) for line in timeless.splitlines() if line.strip()]


def test_examples_of_the_pages(farm: Plants) -> None:
    assert len(EXAMPLES) == 2
    demo = farm.run(ROOT / "config" / "demo.yaml")
    wait_until(lambda: "(up)" in demo.command("trace", "island-03/bus0/1001"))
    wait_until(lambda: demo.command("scan").count(" OP ") == 8)
    for words, printed in EXAMPLES:
        done = run_eapctl(demo.runtime, *shlex.split(words))
        assert done.returncode == 0, done.stderr
        lines = plain(done.stdout)
        assert lines[: len(plain(printed))] == plain(printed)
