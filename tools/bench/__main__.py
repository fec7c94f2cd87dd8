"""Measure speed and memory: ``python -m tools.bench [NAME…] [--quick] [--json FILE] [--markdown]``.

Every figure is a ratio to a named reference that ran in the same minute on the same machine, or
says what it is.  docs/performance.md explains them.
"""

from __future__ import annotations

import argparse
import importlib
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec

from tools.bench import machine
from tools.bench.figures import (
    Decision,
    Figure,
    SkippedError,
    markdown_table,
    replace_between,
    skipped,
    text_table,
)
from tools.bench.network import ROOT
from tools.bench.settings import Settings, quick

NAMES = (
    "throughput", "latency", "onestation", "poll", "lateness", "solar", "limits", "demo",
    "bus", "recording", "web", "mqtt", "opcua", "requests", "receive", "objects", "change",
    "routing", "ads", "gateway", "files", "startup", "acyclic", "cycle", "plantbus", "recovery", "segment",
)  # fmt: skip
PAGE = ROOT / "docs" / "performance.md"
TARGETS = "Targets, and what limits them"
BEGIN, END = "<!-- bench begin -->", "<!-- bench end -->"


class Section(msgspec.Struct, frozen=True):
    """Result of one benchmark."""

    name: str
    title: str
    figures: list[Figure]


def main(arguments: list[str]) -> int:
    """Run the selected benchmarks; return 0 even when a target was missed."""
    options = _parse(arguments)
    settings = quick() if options.quick else Settings()
    about = machine.describe()
    print(about)
    sections = []
    for name in options.names or NAMES:
        section = _run(name, settings)
        sections.append(section)
        print(f"\n{section.title}\n{text_table(section.figures)}", flush=True)
    targets = [figure for section in sections for figure in section.figures if figure.limit]
    print(f"\n{TARGETS}\n{text_table(targets, limits=True)}")
    if options.json:
        data = {"machine": about, "quick": options.quick, "targets": targets, "sections": sections}
        Path(options.json).write_bytes(msgspec.json.format(msgspec.json.encode(data)) + b"\n")
    if options.markdown:
        _write_page(about, targets, sections)
    missed = [f.name for s in sections for f in s.figures if f.decision is Decision.MISSED]
    print(f"\n{len(missed)} targets missed" + "".join(f"\n  {name}" for name in missed))
    return 0


def _parse(arguments: list[str]) -> Any:
    parser = argparse.ArgumentParser(prog="python -m tools.bench", description="Measure the speed.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"any of {', '.join(NAMES)}")
    parser.add_argument("--quick", action="store_true", help="three minutes, rough figures")
    parser.add_argument("--json", metavar="FILE", help="write all figures to FILE")
    parser.add_argument("--markdown", action="store_true", help=f"put the tables into {PAGE.name}")
    options = parser.parse_args(arguments)
    if options.markdown and (options.names or options.quick):
        parser.error("--markdown goes with neither names nor --quick: the page shows a whole run")
    for name in options.names:
        if name not in NAMES:
            parser.error(f"there is no benchmark {name!r}, expected any of {', '.join(NAMES)}")
    return options


def _run(name: str, settings: Settings) -> Section:
    module = importlib.import_module(f"tools.bench.{name}")
    try:
        figures = module.run(settings)
    except SkippedError as reason:
        figures = [skipped(name, reason)]
    except (RuntimeError, subprocess.SubprocessError) as error:
        figures = [Figure(name, f"failed: {error}", decision=Decision.MISSED)]
    return Section(name, module.TITLE, figures)


def _write_page(about: str, targets: list[Figure], sections: list[Section]) -> None:
    tables = [f"### {TARGETS}\n\n{markdown_table(targets, limits=True)}"]
    tables += [f"### {s.title}\n\n{markdown_table(s.figures)}" for s in sections]
    new = "\n\n".join([f"Machine: {about}. Made by `make bench ARGS=--markdown`.", *tables])
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(replace_between(text, BEGIN, END, f"\n{new}\n"), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
