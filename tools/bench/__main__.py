"""Measure speed and memory: ``python -m tools.bench [NAME…] [--quick] [--json FILE] [--markdown]``.

Every figure is a ratio to a named reference that ran in the same minute on the same machine, or
says what it is.  docs/performance.md explains them.
"""

from __future__ import annotations

import argparse
import importlib
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from time import monotonic
from typing import Any

import msgspec
from msgspec.structs import replace

from tools.bench import machine
from tools.bench.charts import Chart, write_charts
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
    "routing", "ads", "gateway", "files", "startup", "acyclic", "cycle", "plantbus", "recovery",
    "segment",
)  # fmt: skip
_FAILURES = (RuntimeError, subprocess.SubprocessError)
PAGE = ROOT / "docs" / "performance.md"
QUIET = ("latency", "lateness", "solar", "limits", "demo", "startup")
"""Benchmarks whose figures are no ratios, or medians of wake-ups: other work changes them."""
REMARK = "A figure with * needs a quiet machine; ratios compare runs of the same minute."
PICTURES = PAGE.parent / "pictures"
TARGETS = "Targets, and what limits them"
BEGIN, END = "<!-- bench begin -->", "<!-- bench end -->"


class Section(msgspec.Struct, frozen=True):
    """Result of one benchmark, and how long it took."""

    name: str
    title: str
    figures: list[Figure]
    seconds: float = 0.0


class Report(msgspec.Struct, frozen=True):
    """Results of one run, as ``--json`` writes them."""

    machine: str
    quick: bool
    targets: list[Figure]
    """Figures of all sections that have a limit."""
    sections: list[Section]


def main(arguments: list[str]) -> int:
    """Run the selected benchmarks; return 0 even when a target was missed."""
    options = _parse(arguments)
    if options.read:
        report = msgspec.json.decode(Path(options.read).read_bytes(), type=Report)
    else:
        report = _measure(options)
    print(f"\n{TARGETS}\n{text_table(report.targets, limits=True)}\n{REMARK}")
    if options.json:
        data = msgspec.json.encode(report)
        Path(options.json).write_bytes(msgspec.json.format(data) + b"\n")
    if options.markdown:
        _write_page(report, _write_charts(PICTURES, report))
    if options.charts:
        _write_charts(Path(options.charts), report)
    missed = [f.name for s in report.sections for f in s.figures if f.decision is Decision.MISSED]
    print(f"\n{len(missed)} targets missed" + "".join(f"\n  {name}" for name in missed))
    return 0


def _measure(options: Any) -> Report:
    settings = quick() if options.quick else Settings()
    about = machine.describe()
    print(about)
    sections = []
    for name in options.names or NAMES:
        section = _run(name, settings)
        sections.append(section)
        settings.tell(f"{name} took {section.seconds:.0f} s")
        print(f"\n{section.title}\n{text_table(section.figures)}", flush=True)
    targets = [
        replace(figure, name=f"{figure.name} *") if section.name in QUIET else figure
        for section in sections
        for figure in section.figures
        if figure.limit
    ]
    return Report(about, options.quick, targets, sections)


def _parse(arguments: list[str]) -> Any:
    parser = argparse.ArgumentParser(prog="python -m tools.bench", description="Measure the speed.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"any of {', '.join(NAMES)}")
    parser.add_argument("--quick", action="store_true", help="five minutes, rough figures")
    parser.add_argument("--json", metavar="FILE", help="write all figures to FILE")
    parser.add_argument("--markdown", action="store_true", help=f"put the tables into {PAGE.name}")
    parser.add_argument("--charts", metavar="FOLDER", help="draw charts of the figures there")
    parser.add_argument(
        "--read", metavar="FILE", help="measure nothing: take the figures of --json"
    )
    options = parser.parse_args(arguments)
    if options.markdown and (options.names or options.quick):
        parser.error("--markdown goes with neither names nor --quick: the page shows a whole run")
    if options.read and (options.names or options.quick):
        parser.error("--read goes with neither names nor --quick: nothing is measured")
    for name in options.names:
        if name not in NAMES:
            parser.error(f"there is no benchmark {name!r}, expected any of {', '.join(NAMES)}")
    return options


def _run(name: str, settings: Settings) -> Section:
    module = importlib.import_module(f"tools.bench.{name}")
    begin = monotonic()
    try:
        figures = _try(module, settings)
    except SkippedError as reason:
        figures = [skipped(name, reason)]
    except _FAILURES as error:
        figures = [Figure(name, f"failed: {error}", decision=Decision.MISSED)]
    return Section(name, module.TITLE, figures, round(monotonic() - begin, 1))


def _try(module: Any, settings: Settings) -> list[Figure]:
    """Run a benchmark, once more if it fails: the machine may have stood still."""
    try:
        return list(module.run(settings))
    except _FAILURES as error:
        settings.tell(f"once more: {error}")
        return list(module.run(settings))


def _write_page(report: Report, charts: Sequence[Chart]) -> None:
    tables = [_shown(chart) for chart in charts]
    tables += [f"### {TARGETS}\n\n{markdown_table(report.targets, limits=True)}\n\n{REMARK}"]
    tables += [f"### {s.title}\n\n{markdown_table(s.figures)}" for s in report.sections]
    made = f"Machine: {report.machine}. Made by `make bench ARGS=--markdown`."
    new = "\n\n".join([made, *tables])
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(replace_between(text, BEGIN, END, f"\n{new}\n"), encoding="utf-8")


def _shown(chart: Chart) -> str:
    return f"![{chart.title}]({PICTURES.name}/{chart.file})"


def _write_charts(folder: Path, report: Report) -> Sequence[Chart]:
    written = write_charts(folder, {s.name: s.figures for s in report.sections})
    for chart in written:
        print(f"{folder / chart.file}: {chart.title}")
    return written


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
