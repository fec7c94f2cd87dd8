"""Measure speed and memory: ``python -m tools.bench [NAME…] [--quick] [--json FILE] [--markdown]``.

Every figure is a ratio to a named reference that ran in the same minute on the same machine, or
says what it is.  docs/performance.md explains them.
"""

from __future__ import annotations

import argparse
import importlib
import subprocess
import sys
from collections.abc import Iterable, Sequence
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
    report = _read([Path(name) for name in options.read]) if options.read else _measure(options)
    print(f"\n{TARGETS}\n{text_table(report.targets, limits=True)}\n{REMARK}")
    if options.json:
        _save(Path(options.json), report)
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
    report = Report(about, options.quick, [], [])
    for name in options.names or NAMES:
        section = _run(name, settings)
        sections = [*report.sections, section]
        report = replace(report, targets=_targets(sections), sections=sections)
        if options.json:  # a run that is ended keeps what it has
            _save(Path(options.json), report)
        settings.tell(f"{name} took {section.seconds:.0f} s")
        print(f"\n{section.title}\n{text_table(section.figures)}", flush=True)
    return report


def _save(path: Path, report: Report) -> None:
    path.write_bytes(msgspec.json.format(msgspec.json.encode(report)) + b"\n")


def _read(paths: Sequence[Path]) -> Report:
    """Return the report of the first file, with the sections that others measured again."""
    first, *others = (msgspec.json.decode(path.read_bytes(), type=Report) for path in paths)
    sections = {section.name: section for each in (first, *others) for section in each.sections}
    return replace(first, targets=_targets(sections.values()), sections=[*sections.values()])


def _targets(sections: Iterable[Section]) -> list[Figure]:
    """Return the figures that have a limit; the names of some end with the mark of REMARK."""
    return [
        replace(figure, name=f"{figure.name} *") if section.name in QUIET else figure
        for section in sections
        for figure in section.figures
        if figure.limit
    ]


def _parse(arguments: list[str]) -> Any:
    parser = argparse.ArgumentParser(prog="python -m tools.bench", description="Measure the speed.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"any of {', '.join(NAMES)}")
    parser.add_argument("--quick", action="store_true", help="five minutes, rough figures")
    parser.add_argument("--json", metavar="FILE", help="write all figures to FILE")
    parser.add_argument("--markdown", action="store_true", help=f"put the tables into {PAGE.name}")
    parser.add_argument("--charts", metavar="FOLDER", help="draw charts of the figures there")
    parser.add_argument(
        "--read",
        metavar="FILE",
        nargs="+",
        help="measure nothing: take the figures that --json wrote, of a benchmark the last ones",
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
    title, begin = name, monotonic()
    try:
        module = importlib.import_module(f"tools.bench.{name}")
        title = module.TITLE
        figures = _try(module, settings)
    except SkippedError as reason:
        figures = [skipped(name, reason)]
    except ModuleNotFoundError as error:
        figures = [skipped(name, f"needs {error.name}")]
    except Exception as error:  # noqa: BLE001  the other benchmarks go on
        figures = [Figure(name, f"failed: {error}", decision=Decision.MISSED)]
    return Section(name, title, figures, round(monotonic() - begin, 1))


def _try(module: Any, settings: Settings) -> list[Figure]:
    """Run a benchmark, once more if it fails: the machine may have stood still."""
    try:
        return list(module.run(settings))
    except (RuntimeError, subprocess.SubprocessError) as error:
        settings.tell(f"once more: {error}")
        return list(module.run(settings))


def _write_page(report: Report, charts: Sequence[Chart]) -> None:
    tables = [f"### {TARGETS}\n\n{markdown_table(report.targets, limits=True)}\n\n{REMARK}"]
    tables += [f"![{chart.title}]({PICTURES.name}/{chart.file})" for chart in charts]
    tables += [f"### {s.title}\n\n{markdown_table(s.figures)}" for s in report.sections]
    made = f"Machine: {report.machine}. Made by `make bench ARGS=--markdown`."
    new = "\n\n".join([made, *tables])
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(replace_between(text, BEGIN, END, f"\n{new}\n"), encoding="utf-8")


def _write_charts(folder: Path, report: Report) -> Sequence[Chart]:
    written = write_charts(folder, {s.name: s.figures for s in report.sections})
    for chart in written:
        print(f"{folder / chart.file}: {chart.title}")
    return written


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
