"""Count what the structure of the code is like: ``python -m tools.structure [-v] [ROOT ...]``.

ROOT is any checkout of the project, also an older one (``git worktree add``); two or more are shown
side by side.  ``--paths`` also runs the demo plant of each and counts the modules that a request
passes, which takes up to a minute; stop another demo first, because it has the addresses.
``-v`` lists the names behind the numbers.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tools.structure.counts import Row, count
from tools.structure.paths import PlantError, trace_paths


def main(arguments: list[str]) -> int:
    """Print the numbers, a column for each checkout."""
    parser = argparse.ArgumentParser(prog="python -m tools.structure", description=__doc__)
    parser.add_argument("root", nargs="*", type=Path, default=[Path(__file__).parents[2]])
    parser.add_argument("-v", "--verbose", action="store_true", help="list the names, too")
    parser.add_argument(
        "--paths",
        action="store_true",
        help="run the demo plant, too: up to a minute; stop another demo first",
    )
    options = parser.parse_args(arguments)
    roots = [root.resolve() for root in options.root]
    try:
        columns = [[*count(root), *(trace_paths(root) if options.paths else [])] for root in roots]
    except PlantError as exc:
        parser.error(str(exc))
    for rows in zip(*columns, strict=True):
        print(format_rows(rows))
        if options.verbose:
            print_names(rows[-1])
    return 0


def format_rows(rows: tuple[Row, ...]) -> str:
    """Return one line: a title and the numbers of all checkouts."""
    return f"{rows[0].title:38}" + "".join(f"{row.value:>9}" for row in rows)


def print_names(row: Row) -> None:
    """Print the names behind a number, one a line."""
    for name in row.names:
        print(f"    {name}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
