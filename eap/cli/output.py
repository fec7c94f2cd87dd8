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
    from rich.console import Console, RenderableType

UNLIMITED = 10_000
"""Columns of a table when stdout is no terminal: no cell is wrapped, no column left out."""


_HOME, _CLEAR_LINE, _CLEAR_BELOW = "\x1b[H", "\x1b[K", "\x1b[J"
"""ECMA-48: cursor to the first column of the first line, erase to the end of line, of screen."""


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
    write_text(_render(_console(), parts), end="")


def repaint(parts: Iterable[RenderableType]) -> None:
    """Print rich renderables in place of what the screen shows; piped, as a block of lines.

    Each line overwrites that of the time before, so that nothing flickers; what exceeds the screen
    is cut off, and a line says so.
    """
    console = _console()
    text = _render(console, parts)
    if not console.is_terminal:
        write_text(text)
        return
    lines = text.rstrip("\n").split("\n")
    room = console.height - 1  # the cursor rests below, where the shell will go on
    if (hidden := len(lines) - room) > 0:
        lines[room - 1 :] = [f"… {hidden + 1} more lines"]
    write_text(_HOME + "".join(f"{line}{_CLEAR_LINE}\n" for line in lines) + _CLEAR_BELOW, end="")


def _console() -> Console:
    from rich.console import Console

    console = Console(highlight=False, emoji=False, markup=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = UNLIMITED
    return console


def _render(console: Console, parts: Iterable[RenderableType]) -> str:
    with console.capture() as capture:
        for part in parts:
            console.print(part)
    text = capture.get()
    if console.is_terminal:
        return text
    return "\n".join(line.rstrip() for line in text.split("\n"))
