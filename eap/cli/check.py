"""``eapctl check``: is this file a plant, and if not, what is wrong with it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from eap.cli.group import ExitCode
from eap.cli.output import write_json, write_text
from eap.cli.params import PLANT_FILE, json_option
from eap.cli.words import count

if TYPE_CHECKING:
    from collections.abc import Sequence

    from eap.config.finding import Finding
    from eap.config.load import Plant


@click.command(short_help="Say at once all that is wrong with a plant file.")
@click.argument("plant", type=PLANT_FILE)
@json_option("Print one object: ok, all findings, and warnings.")
@click.pass_context
def check(ctx: click.Context, plant: Path, as_json: bool) -> None:
    """Check the plant file PLANT, and say at once all that is wrong with it.

    Exits with 2 when anything is.  What works, but not with all commands, is a warning.
    """
    from eap.appliance.commands.plant_check import check_plant  # yaml; --help must not wait

    result, warnings = check_plant(plant)
    for warning in () if as_json else warnings:
        click.echo(f"warning: {warning}", err=True)
    if as_json:
        write_json({
            "ok": not result.findings,
            "findings": result.findings,
            "warnings": warnings,
        })  # fmt: skip
    elif result.plant:
        write_text(f"{plant}: {summary(result.plant)}")
    else:
        report_findings(plant, result.findings)
    if result.findings:
        ctx.exit(ExitCode.UNUSABLE)


def report_findings(plant: Path, findings: Sequence[Finding]) -> None:
    """Print *findings* on stderr, one a line, and how many there are if there are several."""
    for finding in findings:
        click.echo(str(finding), err=True)
    if len(findings) > 1:
        click.echo(f"{plant}: {len(findings)} findings, not a plant yet", err=True)


def summary(plant: Plant) -> str:
    """Return what a plant holds, in numbers."""
    sent = sum(len(frame.pds) for station in plant.stations for frame in station.frames)
    received = sum(len(station.subscriptions) for station in plant.stations)
    return (
        f"plant {plant.name} is well: {count(len(plant.stations), 'station')},"
        f" {count(sent, 'PD')} sent, {count(received, 'PD')} received"
    )
