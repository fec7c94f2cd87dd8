"""``eapctl new``: a plant file to start from."""

from __future__ import annotations

from pathlib import Path

import click

from eap.cli.output import write_json, write_text
from eap.cli.params import json_option, parse_cycle

SHAPES = ("ring", "star")


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
@click.option("--ring", "shape", flag_value="ring", default="ring", help="Each tells the next one.")
@click.option(
    "--star", "shape", flag_value="star", help="The first tells the others, they tell it."
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
    as_json: bool,
) -> None:
    """Write the plant file FILE, or stdout for -, with N stations in a ring or a star.

    Names, NetIDs, addresses and PD ids are allocated; the file explains itself, passes 'eapctl
    check' and runs.
    """
    from eap.config.new_plant import Shape, plant_text

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
        if as_json:
            raise click.UsageError("--json tells of a file: name one in place of -")
        write_text(text, end="")
        return
    _write(file, text, force=force)
    if as_json:
        write_json({"file": str(file), "plant": plant, "shape": shape, "stations": count})
    else:
        write_text(f"{file}: plant {plant}, {count} stations in a {shape}; eapctl run {file}")


def _write(file: Path, text: str, *, force: bool) -> None:
    from eap.appliance.durable import whole_file

    if file.exists() and not force:
        raise click.ClickException(f"{file} exists: write over it with --force")
    with whole_file(file) as target:
        target.write(text.encode())
