"""Everything ``eapctl`` prints: JSON for programs, text and tables for people.

What a command was asked for goes to stdout, what went wrong to stderr.  Whoever reads stdout may
stop early (``| head``): that ends the command quietly and counts as done.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import click

from eap.errors import EnvironmentalError

if TYPE_CHECKING:
    from rich.console import RenderableType

UNLIMITED = 10_000
"""Columns of a table when stdout is no terminal: no cell is wrapped, no column left out."""


def write_json(document: Any) -> None:
    """Print one JSON value on one line of stdout."""
    import msgspec

    write_text(msgspec.json.encode(document).decode())


def write_text(text: str, *, end: str = "\n") -> None:
    """Print *text* on stdout at once; raise EnvironmentalError if it cannot be written."""
    try:
        click.echo(text + end, nl=False)
    except BrokenPipeError:
        _close_stdout()
        raise SystemExit(0) from None
    except OSError as exc:
        _close_stdout()
        raise EnvironmentalError(f"stdout cannot be written: {exc.strerror}") from None


def _close_stdout() -> None:
    """What is still buffered would fail again when the interpreter flushes at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def write_tables(parts: Iterable[RenderableType]) -> None:
    """Print rich renderables on stdout, coloured and fitted to the screen only on a terminal."""
    from rich.console import Console

    console = Console(highlight=False, emoji=False, markup=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = UNLIMITED
    with console.capture() as capture:
        for part in parts:
            console.print(part)
    text = capture.get()
    if not console.is_terminal:
        text = "\n".join(line.rstrip() for line in text.split("\n"))
    write_text(text, end="")
