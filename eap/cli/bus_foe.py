"""``eapctl bus foe``: files of a slave, through its FoE mailbox."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from eap.cli.bus_params import (
    number_up_to,
    slave_argument,
)
from eap.cli.bus_place import BusCommand, Place, bus_options, open_session
from eap.cli.output import write_json, write_text
from eap.cli.params import CommandT, json_option

_STANDARD = Path("-")


def _password_option(command: CommandT) -> CommandT:
    return click.option(
        "--password",
        type=number_up_to(0xFFFFFFFF),
        default=0,
        metavar="N",
        help="If the slave wants one.",
    )(command)


@click.group()
def foe() -> None:
    """Read and write files of a slave (FoE)."""


@foe.command(cls=BusCommand)
@bus_options
@slave_argument
@click.argument("name")
@click.argument("file", required=False, type=click.Path(path_type=Path, dir_okay=False))
@_password_option
@json_option("Print one object; without it a progress bar is on stderr.")
def get(
    slave: str,
    name: str,
    file: Path | None,
    password: int,
    bus: Place,
    as_json: bool,
) -> None:
    """Read the file NAME of a slave into FILE.

    FILE is NAME in this folder if left out, and - for stdout.
    """
    from eap.appliance.commands.bus_foe import get_file

    target = file or Path(Path(name).name)
    is_stdout = target == _STANDARD
    if is_stdout and as_json:
        raise click.UsageError("the file and --json cannot both go to stdout")
    with open_session(bus) as session, _progress(name, hidden=as_json) as report:
        whole = None if is_stdout else target
        row = get_file(session, slave, name, whole, password=password, report=report)
    _show(row, f"{row['name']} → {row['file']}", as_json=as_json, is_stdout_taken=is_stdout)


@foe.command(cls=BusCommand)
@bus_options
@slave_argument
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
@click.argument("name", required=False)
@_password_option
@json_option("Print one object; without it a progress bar is on stderr.")
def put(
    slave: str,
    file: Path,
    name: str | None,
    password: int,
    bus: Place,
    as_json: bool,
) -> None:
    """Write FILE to a slave, as NAME if that is given.

    FILE is - for stdin, which needs a NAME.
    """
    from eap.appliance.commands.bus_foe import put_file

    is_stdin = file == _STANDARD
    if is_stdin and not name:
        raise click.UsageError("what comes from stdin needs a NAME at the slave")
    target = name or file.name
    with open_session(bus) as session, _progress(target, hidden=as_json) as report:
        source = None if is_stdin else file
        row = put_file(session, slave, source, target, password=password, report=report)
    _show(row, f"{row['file']} → {row['name']}", as_json=as_json)


def _show(row: dict[str, Any], what: str, *, as_json: bool, is_stdout_taken: bool = False) -> None:
    if as_json:
        write_json(row)
        return
    speed = f"{row['rate'] / 1000:.0f} kB/s"
    text = (
        f"{what}: {row['octets']} octets in {row['seconds']:.1f} s, {speed}\nsha256 {row['sha256']}"
    )
    if row["restarts"]:
        text += f"\nbegan anew {row['restarts']} times: the bus had interrupted it"
    if is_stdout_taken:
        click.echo(text, err=True)
    else:
        write_text(text)


@contextmanager
def _progress(name: str, *, hidden: bool) -> Iterator[Callable[[int, int | None, int], None]]:
    """Show a bar on stderr while a file is on its way; only a terminal gets one."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        DownloadColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
        TransferSpeedColumn,
    )

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    disable = hidden or not console.is_terminal
    with Progress(*columns, console=console, disable=disable) as bar:
        task = bar.add_task(name, total=None)

        def report(done: int, total: int | None, restarts: int) -> None:
            again = f" (restart {restarts})" if restarts else ""
            bar.update(task, completed=done, total=total, description=f"{name}{again}")

        yield report
