"""Changes of a running plant by its plant file: ``plan``, ``apply`` and ``rollback``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import click

from eap.cli.group import ExitCode
from eap.cli.output import CommandT, Renderer, json_option, write_text
from eap.cli.params import PLANT_FILE
from eap.errors import ControlError
from eap.ids import ObjectId
from eap.quantities import count

if TYPE_CHECKING:
    from eap.control.device import ObjectChange
    from eap.ops.plant import AwayHost, ChangeReport, PlanReport, PlantLink, StepOutcome
    from eap.pd.spec import StationSpec


_SIGNS = {"added": "+", "removed": "-", "changed": "~"}
_EMPTY = '""'


def plant_arguments(command: CommandT) -> CommandT:
    """Add PLANT, ``--station`` and ``--local``."""
    stations = click.option(
        "--station",
        "stations",
        multiple=True,
        metavar="NAME",
        help="Only this station; repeatable.",
    )
    local = click.option(
        "--local",
        is_flag=True,
        help="Only stations that run on this computer, of a plant with several hosts.",
    )
    return click.argument("plant", type=PLANT_FILE)(stations(local(command)))


keep_going_option = click.option(
    "--keep-going", is_flag=True, help="Continue with the other stations when one refuses."
)
_RESULT = json_option("Print one object: ok, the steps with their results, refusals.")


@contextmanager
def running_plant(
    file: Path, wanted: tuple[str, ...], *, local: bool
) -> Iterator[tuple[PlantLink, dict[str, StationSpec]]]:
    """Connect to the running part of the plant in *file*, for the length of a block.

    Yields:
        The connections, and the specifications of the *wanted* stations: of all that run here, or
        on hosts that are reached, unless some are named.
    """
    from eap.live.plant_hosts import link_to_hosts
    from eap.ops.plant import choose, load_or_raise

    with link_to_hosts(load_or_raise(file), file, local=local) as (link, plant, notes):
        for note in notes:
            click.echo(note, err=True)
        for name, keys in link.sections_to_restart(plant).items():
            note = f"{name}: {', '.join(keys)}: not as in the file: restart the appliance"
            click.echo(note, err=True)
        yield link, choose(plant, link, wanted)


@click.command()
@plant_arguments
@json_option("Print one object: ok, stations with changes, the steps of 'apply', absent stations.")
@click.pass_context
def plan(
    ctx: click.Context, plant: Path, stations: tuple[str, ...], local: bool, output: Renderer
) -> None:
    """Show the differences, object by object, between PLANT and its stations that run here.

    Changes nothing.  Exits with 1 when a station cannot be changed as the file requires while it
    runs.
    """
    from eap.ops.plant import PlanReport, plan_all, start_command, steps_to

    with running_plant(plant, stations, local=local) as (link, wanted):
        plans = plan_all(link, wanted)
        is_possible = not any(each.refused for each in plans)
        order = steps_to(link, wanted) if is_possible else []
        away = () if stations else link.away
        report = PlanReport.of(plans, order, () if stations or local else link.absent, away)
        hosts = link.hosts
    command = start_command(plant, report.absent)
    output.show(report, lambda each: plan_lines(each, command, hosts))
    if not report.ok:
        ctx.exit(ExitCode.FAILED)


@click.command()
@plant_arguments
@keep_going_option
@_RESULT
@click.pass_context
def apply(
    ctx: click.Context,
    plant: Path,
    stations: tuple[str, ...],
    local: bool,
    keep_going: bool,
    output: Renderer,
) -> None:
    """Apply PLANT to its stations that run here, without a restart.

    Unchanged parts continue undisturbed.  Each station changes between two of its cycles and keeps
    the change over a restart.  A receiver accepts a new layout beside the old one before a sender
    uses it.  The command ends at the first refusal of a station; 'eapctl rollback' restores the
    previous state.

    Exits with 1 when a station refuses.
    """
    from eap.ops.plant import apply_steps, cause_of_change, plan_all, steps_to

    with running_plant(plant, stations, local=local) as (link, wanted):
        away = () if stations else link.away
        refusing = {each.station: each.refused for each in plan_all(link, wanted) if each.refused}
        # Without --keep-going one refusal stops all: no station changes before all have agreed.
        is_on = keep_going or not (refusing or away)
        chosen = {name: spec for name, spec in wanted.items() if is_on and name not in refusing}
        # Receivers first: a receiver accepts a new layout beside the old one.
        order = steps_to(link, chosen)
        cause = cause_of_change(link)
        steps = apply_steps(link, order, keep_going=keep_going, routed=chosen, cause=cause)
        is_undone = len(set(link.hosts.values())) > 1 and not keep_going
        _run_steps(ctx, steps, link, output, refusing, away, cause if is_undone else "")


@click.command()
@plant_arguments
@keep_going_option
@_RESULT
@click.pass_context
def rollback(
    ctx: click.Context,
    plant: Path,
    stations: tuple[str, ...],
    local: bool,
    keep_going: bool,
    output: Renderer,
) -> None:
    """Undo the last change of the stations of PLANT that run here.

    Other stations keep their configuration.  A second rollback undoes the first one.

    Exits with 1 when a station refuses.
    """
    from eap.ops.plant import roll_back

    with running_plant(plant, stations, local=local) as (link, wanted):
        steps = roll_back(link, tuple(wanted), keep_going=keep_going)
        _run_steps(ctx, steps, link, output, away=() if stations else link.away)


def _run_steps(
    ctx: click.Context,
    steps: Iterable[StepOutcome],
    link: PlantLink,
    output: Renderer,
    refusing: Mapping[str, list[str]] = MappingProxyType({}),
    away: tuple[AwayHost, ...] = (),
    undo: str = "",
) -> None:
    """Run all steps, print each when it is done, and then the whole result.

    Args:
        ctx: Of the command.
        steps: The steps.
        link: To the stations.
        output: Prints the result.
        refusing: Reasons of stations that cannot change while they run.
        away: Hosts that are not reached.
        undo: Name of the change that is taken back when it fails; empty to leave it.
    """
    from eap.ops.plant import ChangeReport, roll_back

    taken, error = _take(steps, link, output)
    undone: list[StepOutcome] = []
    failed = error is not None or not all(step.outcome.ok for step in taken)
    if undo and failed:
        # All hosts or none: what was changed before the failure is taken back.
        reached = link.reached()
        away = reached.away
        back = roll_back(reached, reached.stations, keep_going=True, cause=undo)
        undone, interruption = _take(back, link, output, "taken back: ")
        error = error or interruption
    report = ChangeReport.of(taken, refusing, error, away, undone)
    output.show(report, lambda each: _end_lines(each, len(link.stations)))
    if error is not None:
        raise error
    if not report.ok:
        ctx.exit(ExitCode.FAILED)


def _take(
    steps: Iterable[StepOutcome], link: PlantLink, output: Renderer, prefix: str = ""
) -> tuple[list[StepOutcome], ControlError | None]:
    """Run *steps* and print them; return their outcomes, and the error that interrupted them."""
    taken: list[StepOutcome] = []
    try:
        for step in steps:
            taken.append(step)
            if not output.is_json:
                # As they are done: a change of many stations takes a while, and may be
                # interrupted.
                head, *lines = _step_lines(step, link.hosts)
                write_text("\n".join((f"{prefix}{head}", *lines)))
    except ControlError as exc:
        return taken, exc
    return taken, None


def plan_lines(
    report: PlanReport, command: str, hosts: Mapping[str, str] = MappingProxyType({})
) -> Iterator[str]:
    """Yield the differences of each station, the steps, and the *command* for absent stations.

    Args:
        report: The result.
        command: Starts the absent stations.
        hosts: Host of each station, for a plant of several.
    """
    plans = report.stations
    differing = [each for each in plans if each.differs]
    for each in differing:
        yield _on_host(each.station, hosts)
        yield from (f"  {line}" for line in _change_lines(each.changes))
        yield from (f"  * {note}" for note in each.notes)
        yield from (f"  ! {reason}" for reason in each.refused)
    if differing:
        yield from _plan_summary(report, hosts)
    elif plans:
        names = [each.station for each in plans]
        all_of = f"{names[0]} is" if len(names) == 1 else f"all {len(names)} stations are"
        yield f"no differences: {all_of} as the file says"
    if report.absent:
        yield f"not running here: {', '.join(report.absent)}; start them with:"
        yield f"  {command}"
    yield from _away_lines(report.away)


def _on_host(station: str, hosts: Mapping[str, str]) -> str:
    return f"{station} on {hosts[station]}" if station in hosts else station


def _away_lines(away: Iterable[AwayHost]) -> Iterator[str]:
    for host in away:
        yield f"host {host.host} ({', '.join(host.stations)}): {host.reason}"


def _plan_summary(report: PlanReport, hosts: Mapping[str, str]) -> Iterator[str]:
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
        + (f", {others} unchanged" if others else "")
    )
    if refusing:
        yield f"cannot be applied: {', '.join(refusing)} refused"
    elif len(report.steps) > 1:
        yield "'eapctl apply' takes these steps:"
        for number, step in enumerate(report.steps, 1):
            yield f"  {number}. {_on_host(step.station, hosts)} {step.why}"


def change_text(change: ObjectChange, name: str) -> str:
    """Return one change, such as ``~ 0xD000:07 TxPD 0 (state): Cycle time  10000 -> 20000 us``."""
    old, new = _shortened(change.old), _shortened(change.new)
    values = f"{old or _EMPTY} -> {new or _EMPTY}" if change.change == "changed" else new
    unit = f" {change.unit}" if values and change.unit else ""
    entry = ObjectId(change.index, change.subindex)
    return f"{_SIGNS[change.change]} {entry} {name}  {values}{unit}".rstrip()


_SHOWN = 120
"""Characters of a value; the whole definition of a type has more."""


def _shortened(text: str) -> str:
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


def _change_lines(changes: Sequence[ObjectChange]) -> Iterator[str]:
    """Yield a line for each change, with its port if there is more than one port."""
    several = len({change.port for change in changes}) > 1
    for change in changes:
        yield change_text(change, f"{change.port}: {change.name}" if several else change.name)


def _step_lines(step: StepOutcome, hosts: Mapping[str, str]) -> Iterator[str]:
    """Yield the result of one step."""
    outcome = step.outcome
    yield f"{_on_host(step.station, hosts)} {step.why}: {'ok' if outcome.ok else 'refused'}"
    for line, result in zip(_change_lines(outcome.results), outcome.results, strict=True):
        yield f"  {line}  {'ok' if result.ok else result.reason}"
    yield from (f"  ! {reason}" for reason in outcome.refused)


def _end_lines(report: ChangeReport, stations: int) -> Iterator[str]:
    """Yield the result of all steps, and the remedy if these were not all.

    Args:
        report: The result.
        stations: Number of stations that are reached.
    """
    for each in report.refused:
        yield f"{each.station} cannot change while it runs"
        yield from (f"  ! {reason}" for reason in each.refused)
    yield from _away_lines(report.away)
    refused = [step.station for step in report.steps if not step.ok]
    taken_back = {step.station for step in report.undone if step.ok}
    changed = list(dict.fromkeys(step.station for step in report.steps if step.ok))
    left = [name for name in changed if name not in taken_back]
    if not changed:
        yield "no station changed"
        return
    if taken_back and not left:
        yield f"no station changed: taken back at {', '.join(n for n in changed)}"
        return
    others = stations - len(left)
    rest = f", {others} unchanged" if others else ""
    yield f"{count(len(left), 'station')} changed{rest}"
    if refused or report.error is not None:
        what = f"{', '.join(refused)} refused" if refused else "interrupted"
        yield f"{what}: changed so far: {', '.join(left)}"
        yield "'eapctl apply' continues, 'eapctl rollback' restores the previous state"
