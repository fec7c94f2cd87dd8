"""``eapctl check`` and ``new``: the plant file itself."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eap.cli.group import ExitCode
from eap.cli.output import Renderer, write_text
from eap.cli.params import PLANT_FILE, json_option, parse_cycle

if TYPE_CHECKING:
    from eap.config.load import Plant

SHAPES = ("ring", "star")


@click.command(short_help="Report all errors of a plant file at once.")
@click.argument("plant", type=PLANT_FILE)
@json_option("Print one object: ok, all findings, and warnings.")
@click.pass_context
def check(ctx: click.Context, plant: Path, output: Renderer) -> None:
    """Check the plant file PLANT, and report all errors at once.

    Exits with 2 when there is an error.  What works, but not with all commands, is a warning.
    """
    from eap.ops.plant_check import check_plant  # yaml; --help must not wait

    found, checked = check_plant(plant)
    for warning in found.warnings:
        output.remark(f"warning: {warning}")
    for finding in found.findings:
        output.remark(str(finding))
    if len(found.findings) > 1:
        output.remark(f"{plant}: {len(found.findings)} findings, not a plant yet")
    output.show(found, lambda _: _summary(plant, checked))
    if found.findings:
        ctx.exit(ExitCode.UNUSABLE)


def _summary(file: Path, plant: Plant | None) -> Iterator[str]:
    """Yield the numbers of stations and PDs of a plant without errors."""
    from eap.cli.table import count

    if plant is None:
        return
    sent = sum(len(frame.pds) for station in plant.stations for frame in station.frames)
    received = sum(len(station.subscriptions) for station in plant.stations)
    yield (
        f"{file}: no errors (plant {plant.name}: {count(len(plant.stations), 'station')},"
        f" {count(sent, 'PD')} sent, {count(received, 'PD')} received)"
    )


@click.command(short_help="Write a plant file to start from.")
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False, allow_dash=True))
@click.option(
    "--stations",
    "count",
    type=click.IntRange(2, 250),
    default=3,
    show_default=True,
    metavar="N",
    help="How many stations.",
)
@click.option("--ring", "shape", flag_value="ring", default="ring", help="Each sends to the next.")
@click.option(
    "--star", "shape", flag_value="star", help="The first sends to the others, they send to it."
)
@click.option("--name", metavar="NAME", help="Name of the plant; the file's unless given.")
@click.option(
    "--address",
    default="127.0.1.{n}",
    show_default=True,
    metavar="PATTERN",
    help="Addresses of the stations: {n} is a station's number; 10.0.0.11 is that of the first, the"
    " others follow; ethernet://eth0 is the interface of each on its host.",
)
@click.option(
    "--cycle",
    "cycle_us",
    callback=parse_cycle,
    default="10",
    show_default=True,
    metavar="MS",
    help="Device cycle in milliseconds.",
)
@click.option("--force", is_flag=True, help="Write over a file that is there.")
@json_option("Print one object: file, plant and stations.")
def new(
    file: Path,
    count: int,
    shape: str,
    name: str | None,
    address: str,
    cycle_us: int,
    force: bool,
    output: Renderer,
) -> None:
    """Write the plant file FILE, or stdout for -, with N stations in a ring or a star.

    Names, NetIDs, addresses and PD ids are allocated; the file explains itself, passes 'eapctl
    check' and runs.
    """
    from eap.config.new_plant import NewPlant, Shape, plant_text

    is_stdout = str(file) == "-"
    plant = name or ("plant" if is_stdout else file.stem)
    text = plant_text(
        plant,
        count,
        Shape(shape),
        address=address,
        cycle_us=cycle_us,
        file="FILE" if is_stdout else str(file),
    )
    if is_stdout:
        if output.is_json:
            raise click.UsageError("--json tells of a file: name one in place of -")
        write_text(text, end="")
        return
    _write(file, text, force=force)
    created = NewPlant(str(file), plant, shape, count)
    output.show(
        created,
        lambda _: f"{file}: plant {plant}, {count} stations in a {shape}; eapctl run {file}",
    )


def _write(file: Path, text: str, *, force: bool) -> None:
    from eap.runtime.durable import whole_file

    if file.exists() and not force:
        raise click.ClickException(f"{file} exists: write over it with --force")
    with whole_file(file) as target:
        target.write(text.encode())
