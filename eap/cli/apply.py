"""``eapctl apply`` and ``rollback``: a running plant becomes what its file says, and back."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from eap.cli.group import ExitCode
from eap.cli.output import write_json, write_text
from eap.cli.params import json_option
from eap.cli.plant_params import keep_going_option, plant_arguments, running_plant
from eap.errors import ControlError

if TYPE_CHECKING:
    from eap.appliance.commands.plant_change import Done
    from eap.appliance.commands.plant_link import PlantLink


@click.command(short_help="Let a running plant become what its file says.")
@plant_arguments
@keep_going_option
@json_option("Print one object: ok, the steps with their results, and what each station runs.")
@click.pass_context
def apply(
    ctx: click.Context, plant: Path, stations: tuple[str, ...], keep_going: bool, as_json: bool
) -> None:
    """Let the stations of PLANT that run here become what the file says, while they run.

    What stays as it is goes on undisturbed.  Each station changes between two of its cycles, and
    keeps the change over a restart.  Whoever receives a new layout takes it beside the old one
    before anybody sends it.  The first station that refuses ends it; 'eapctl rollback' brings back
    what ran before.

    Exits with 1 when a station refused.
    """
    from eap.appliance.commands.plant_change import apply_steps, plan_all, steps_to

    with running_plant(plant, stations) as (link, wanted):
        refusing = {each.station: each.refused for each in plan_all(link, wanted) if each.refused}
        is_on = keep_going or not refusing
        chosen = {name: spec for name, spec in wanted.items() if is_on and name not in refusing}
        order = steps_to(link, chosen)
        done = _take(
            apply_steps(link, order, keep_going=keep_going, routed=chosen), as_json=as_json
        )
        _finish(ctx, link, done, refusing, as_json=as_json)


@click.command(short_help="Bring back what a plant ran before the last change.")
@plant_arguments
@keep_going_option
@json_option("Print one object: ok, the steps with their results, and what each station runs.")
@click.pass_context
def rollback(
    ctx: click.Context, plant: Path, stations: tuple[str, ...], keep_going: bool, as_json: bool
) -> None:
    """Bring the stations of PLANT that run here back to what they ran before the last change.

    Stations that it left alone stay as they are.  A second rollback undoes the first one.

    Exits with 1 when a station refused.
    """
    from eap.appliance.commands.plant_change import roll_back

    with running_plant(plant, stations) as (link, wanted):
        done = _take(roll_back(link, tuple(wanted), keep_going=keep_going), as_json=as_json)
        _finish(ctx, link, done, {}, as_json=as_json)


class _Taken(NamedTuple):
    """The steps that were taken, and what broke them off."""

    steps: list[Done]
    error: ControlError | None


def _take(steps: Iterable[Done], *, as_json: bool) -> _Taken:
    """Take all steps, and tell of each as soon as it is done."""
    from eap.cli.plan_view import done_lines

    taken: list[Done] = []
    try:
        for done in steps:
            taken.append(done)
            if not as_json:
                for line in done_lines(done):
                    write_text(line)
    except ControlError as exc:
        return _Taken(taken, exc)
    return _Taken(taken, None)


def _finish(
    ctx: click.Context,
    link: PlantLink,
    taken: _Taken,
    refusing: dict[str, list[str]],
    *,
    as_json: bool,
) -> None:
    """Say what came of it, and end with the exit code that stands for it."""
    from eap.cli.plan_view import end_lines

    is_ok = not (refusing or taken.error) and all(each.outcome.ok for each in taken.steps)
    if as_json:
        steps = [
            {
                "station": each.station,
                "why": each.why,
                "ok": each.outcome.ok,
                "results": each.outcome.results,
                "refused": each.outcome.refused,
            }
            for each in taken.steps
        ]
        refused = [{"station": name, "refused": why} for name, why in refusing.items()]
        error = None if taken.error is None else str(taken.error)
        write_json({"ok": is_ok, "steps": steps, "refused": refused, "error": error})
    else:
        is_broken_off = taken.error is not None
        for line in end_lines(
            taken.steps, refusing, len(link.stations), is_broken_off=is_broken_off
        ):
            write_text(line)
    if taken.error is not None:
        raise taken.error
    if not is_ok:
        ctx.exit(ExitCode.FAILED)
