"""``eapctl plan``: what differs between a plant file and what runs of it."""

from __future__ import annotations

from pathlib import Path

import click

from eap.cli.group import ExitCode
from eap.cli.output import write_json, write_text
from eap.cli.params import json_option
from eap.cli.plant_params import plant_arguments, running_plant


@click.command(short_help="Show what differs between a plant file and what runs.")
@plant_arguments
@json_option("Print one object: ok, stations with changes, the steps of 'apply', who is absent.")
@click.pass_context
def plan(ctx: click.Context, plant: Path, stations: tuple[str, ...], as_json: bool) -> None:
    """Show, object by object, what differs between PLANT and its stations that run here.

    Nothing is changed.  Exits with 1 when a station cannot become what the file says while it runs.
    """
    from eap.appliance.commands.plant_change import plan_all, start_command, steps_to
    from eap.cli.plan_view import plan_lines

    with running_plant(plant, stations) as (link, wanted):
        plans = plan_all(link, wanted)
        is_possible = not any(each.refused for each in plans)
        order = steps_to(link, wanted) if is_possible else []
        absent = () if stations else link.absent
    if as_json:
        rows = [
            {
                "station": each.station,
                "changes": each.changes,
                "notes": each.notes,
                "refused": each.refused,
            }
            for each in plans
        ]
        steps = [{"station": step.station, "why": step.why} for step in order]
        write_json({"ok": is_possible, "stations": rows, "steps": steps, "absent": absent})
    else:
        for line in plan_lines(plans, order):
            write_text(line)
        if absent:
            write_text(f"not running here: {', '.join(absent)}; start them with:")
            write_text(f"  {start_command(plant, absent)}")
    if not is_possible:
        ctx.exit(ExitCode.FAILED)
