"""``eapctl plan``, ``apply`` and ``rollback``: changes of a running plant by its plant file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eap.cli.group import ExitCode
from eap.cli.output import Renderer, write_text
from eap.cli.params import PLANT_FILE, CommandT, json_option
from eap.errors import ControlError
from eap.ids import ObjectId

if TYPE_CHECKING:
    from eap.control.device import ObjectChange
    from eap.ops.plant_change import (
        ChangeReport,
        PlanReport,
        PlantLink,
        StepOutcome,
    )
    from eap.pd.spec import StationSpec

_SIGNS = {"added": "+", "removed": "-", "changed": "~"}
_EMPTY = '""'


def plant_arguments(command: CommandT) -> CommandT:
    """Add PLANT and ``--station``."""
    stations = click.option(
        "--station",
        "stations",
        multiple=True,
        metavar="NAME",
        help="Only this station; may be given several times.",
    )
    return click.argument("plant", type=PLANT_FILE)(stations(command))


keep_going_option = click.option(
    "--keep-going", is_flag=True, help="Go on with the other stations when one refuses."
)
_RESULT = json_option("Print one object: ok, the steps with their results, and refusals.")


@contextmanager
def running_plant(
    file: Path, wanted: tuple[str, ...]
) -> Iterator[tuple[PlantLink, dict[str, StationSpec]]]:
    """Connect to the running part of the plant in *file*, for the length of a block.

    Yields:
        The connections, and the specifications of the *wanted* stations: of all that run here
        unless some are named.
    """
    from eap.ops.plant_change import choose, link_to, load_or_raise

    plant = load_or_raise(file)
    with link_to(plant, file) as link:
        yield link, choose(plant, link, wanted)


@click.command(short_help="Show the differences between a plant file and the running plant.")
@plant_arguments
@json_option("Print one object: ok, stations with changes, the steps of 'apply', absent stations.")
@click.pass_context
def plan(ctx: click.Context, plant: Path, stations: tuple[str, ...], output: Renderer) -> None:
    """Show the differences, object by object, between PLANT and its stations that run here.

    Nothing is changed.  Exits with 1 when a station cannot become what the file says while it runs.
    """
    from eap.ops.plant_change import PlanReport, plan_all, start_command, steps_to

    with running_plant(plant, stations) as (link, wanted):
        plans = plan_all(link, wanted)
        is_possible = not any(each.refused for each in plans)
        order = steps_to(link, wanted) if is_possible else []
        report = PlanReport.of(plans, order, () if stations else link.absent)
    command = start_command(plant, report.absent)
    output.show(report, lambda each: plan_lines(each, command))
    if not is_possible:
        ctx.exit(ExitCode.FAILED)


@click.command(short_help="Apply a plant file to the running plant.")
@plant_arguments
@keep_going_option
@_RESULT
@click.pass_context
def apply(
    ctx: click.Context, plant: Path, stations: tuple[str, ...], keep_going: bool, output: Renderer
) -> None:
    """Apply PLANT to its stations that run here, without a restart.

    Everything without a change goes on undisturbed.  Each station changes between two of its
    cycles, and keeps the change over a restart.  A receiver takes a new layout beside the old one
    before anything sends it.  The first refusal of a station ends it; 'eapctl rollback' brings back
    the state before.

    Exits with 1 when a station refused.
    """
    from eap.ops.plant_change import apply_steps, plan_all, steps_to

    with running_plant(plant, stations) as (link, wanted):
        refusing = {each.station: each.refused for each in plan_all(link, wanted) if each.refused}
        is_on = keep_going or not refusing
        chosen = {name: spec for name, spec in wanted.items() if is_on and name not in refusing}
        order = steps_to(link, chosen)
        steps = apply_steps(link, order, keep_going=keep_going, routed=chosen)
        _run_steps(ctx, steps, link, refusing, output)


@click.command(short_help="Take back the last change of a running plant.")
@plant_arguments
@keep_going_option
@_RESULT
@click.pass_context
def rollback(
    ctx: click.Context, plant: Path, stations: tuple[str, ...], keep_going: bool, output: Renderer
) -> None:
    """Take back the last change of the stations of PLANT that run here.

    Stations that it did not change stay as they are.  A second rollback undoes the first one.

    Exits with 1 when a station refused.
    """
    from eap.ops.plant_change import roll_back

    with running_plant(plant, stations) as (link, wanted):
        _run_steps(ctx, roll_back(link, tuple(wanted), keep_going=keep_going), link, {}, output)


def _run_steps(
    ctx: click.Context,
    steps: Iterable[StepOutcome],
    link: PlantLink,
    refusing: Mapping[str, list[str]],
    output: Renderer,
) -> None:
    """Take all steps, print the text of each when it is done, and then the whole result."""
    from eap.ops.plant_change import ChangeReport

    taken: list[StepOutcome] = []
    error: ControlError | None = None
    try:
        for step in steps:
            taken.append(step)
            if not output.is_json:
                for line in _step_lines(step):
                    write_text(line)
    except ControlError as exc:
        error = exc
    report = ChangeReport.of(taken, refusing, error)
    output.show(report, lambda each: _end_lines(each, len(link.stations)))
    if error is not None:
        raise error
    if not report.ok:
        ctx.exit(ExitCode.FAILED)


def plan_lines(report: PlanReport, command: str) -> Iterator[str]:
    """Yield the differences of each station, the steps, and the *command* for absent stations."""
    plans = report.stations
    differing = [each for each in plans if each.differs]
    for each in differing:
        yield each.station
        yield from (f"  {line}" for line in _change_lines(each.changes))
        yield from (f"  * {note}" for note in each.notes)
        yield from (f"  ! {reason}" for reason in each.refused)
    if differing:
        yield from _plan_summary(report)
    else:
        names = [each.station for each in plans]
        all_of = f"{names[0]} is" if len(names) == 1 else f"all {len(names)} stations are"
        yield f"nothing differs: {all_of} as the file says"
    if report.absent:
        yield f"not running here: {', '.join(report.absent)}; start them with:"
        yield f"  {command}"


def _plan_summary(report: PlanReport) -> Iterator[str]:
    from eap.cli.table import count

    differing = [each for each in report.stations if each.differs]
    refusing = [each.station for each in differing if each.refused]
    kinds = [change.change for each in differing for change in each.changes]
    numbers = ", ".join(
        f"{kinds.count(kind)} {kind}" for kind in ("added", "removed", "changed") if kind in kinds
    )
    others = len(report.stations) - len(differing)
    yield (
        f"{count(len(differing), 'station')} of {len(report.stations)} to change"
        + (f" ({numbers})" if numbers else "")
        + (f", {others} as the file says" if others else "")
    )
    if refusing:
        yield f"cannot be applied: {', '.join(refusing)} refused"
    elif len(report.steps) > 1:
        yield "'eapctl apply' goes these steps:"
        for number, step in enumerate(report.steps, 1):
            yield f"  {number}. {step.station} {step.why}"


def change_text(change: ObjectChange, name: str) -> str:
    """Return one change, such as ``~ 0xD000:07 TxPD 0 (state): Cycle time  10000 -> 20000 us``."""
    old, new = change.old, change.new
    values = f"{old or _EMPTY} -> {new or _EMPTY}" if change.change == "changed" else new
    unit = f" {change.unit}" if values and change.unit else ""
    entry = ObjectId(change.index, change.subindex)
    return f"{_SIGNS[change.change]} {entry} {name}  {values}{unit}".rstrip()


def _change_lines(changes: Sequence[ObjectChange]) -> Iterator[str]:
    """Yield a line for each change, with its port if there is more than one port."""
    several = len({change.port for change in changes}) > 1
    for change in changes:
        yield change_text(change, f"{change.port}: {change.name}" if several else change.name)


def _step_lines(step: StepOutcome) -> Iterator[str]:
    """Yield the result of one step."""
    outcome = step.outcome
    yield f"{step.station} {step.why}: {'ok' if outcome.ok else 'refused'}"
    for line, result in zip(_change_lines(outcome.results), outcome.results, strict=True):
        yield f"  {line}  {'ok' if result.ok else result.reason}"
    yield from (f"  ! {reason}" for reason in outcome.refused)


def _end_lines(report: ChangeReport, stations: int) -> Iterator[str]:
    """Yield the result of all steps, and the remedy if these were not all.

    Args:
        report: The result.
        stations: Number of stations that run here.
    """
    from eap.cli.table import count

    for each in report.refused:
        yield f"{each.station} cannot change while it runs"
        yield from (f"  ! {reason}" for reason in each.refused)
    refused = [step.station for step in report.steps if not step.ok]
    changed = list(dict.fromkeys(step.station for step in report.steps if step.ok))
    if not changed:
        yield "nothing was changed"
        return
    others = stations - len(changed)
    rest = f", {others} as before" if others else ""
    yield f"{count(len(changed), 'station')} changed{rest}"
    if refused or report.error is not None:
        what = f"{', '.join(refused)} refused" if refused else "broken off"
        are = "is" if len(changed) == 1 else "are"
        yield f"{what}: changed until then {are} {', '.join(changed)}"
        yield "'eapctl apply' goes on with it, 'eapctl rollback' brings back the state before"
