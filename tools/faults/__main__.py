"""Try every fault and show what the master reports: ``python -m tools.faults [--write | --json]``.

The faults happen on a virtual clock, so that every run says the same; ``--write`` puts it into
docs/faults.md, which a test compares with what happens.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec

from tools.bench.figures import replace_between
from tools.faults.case import CASES
from tools.faults.trial import Row, Trial

PAGE = Path(__file__).resolve().parents[2] / "docs" / "faults.md"
BEGIN, END = "<!-- faults begin -->", "<!-- faults end -->"


def main(arguments: Sequence[str]) -> int:
    """Try all faults; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tools.faults", description="Try all faults.")
    parser.add_argument("--write", action="store_true", help=f"put the table into {PAGE.name}")
    parser.add_argument("--json", action="store_true", help="one object a fault")
    options = parser.parse_args(arguments)
    rows = [Trial(case).run() for case in CASES]
    if options.write:
        PAGE.write_text(put_into(PAGE.read_text(encoding="utf-8"), rows), encoding="utf-8")
    elif options.json:
        for row in rows:
            print(msgspec.json.encode(row).decode())
    else:
        print(as_markdown(rows))
    return 0


def put_into(text: str, rows: Sequence[Row]) -> str:
    """Return the page *text* with these rows."""
    return replace_between(text, BEGIN, END, f"\n{as_markdown(rows)}\n")


def as_markdown(rows: Sequence[Row]) -> str:
    """Return a table of all faults, and behind it each in detail."""
    lines = ["| what happens | fault | first report | all in OP again |", "|---|---|---|---|"]
    lines += [f"| {row.what} | `{row.kind}` | {_first(row)} | {row.again} |" for row in rows]
    lines += ["", "## One by one"]
    for row in rows:
        lines += ["", f"**{row.what}**", "", *_details(row)]
    return "\n".join(lines)


def _first(row: Row) -> str:
    """Say how one notices: by the first event, else by what a request or a counter says."""
    if row.events:
        return row.events[0]
    return "counters" if row.counters else "the request" if row.request else "diagnosis"


def _details(row: Row) -> Iterator[str]:
    yield from (f"- {event}" for event in row.events)
    if row.counters:
        yield f"- counted: {row.counters}"
    if row.request:
        yield f"- {row.request}"
    if row.diagnosis:
        yield f"- diagnosis: {row.diagnosis}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
