"""Commands of a plant file: ``check``, ``new``, ``run``, ``plan``, ``apply`` and ``rollback``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from eap.cli.group import ExitCode
from eap.cli.output import Renderer, write_text
from eap.cli.params import PLANT_FILE, CommandT, check_new_file, json_option, parse_cycle
from eap.errors import ConfigError, ControlError
from eap.ids import ObjectId
from eap.quantities import count

if TYPE_CHECKING:
    from eap.config.load import Plant
    from eap.control.device import ObjectChange
    from eap.ops.check import CheckedBus, CheckedPlant
    from eap.ops.plant import AwayHost, ChangeReport, PlanReport, PlantLink, StepOutcome
    from eap.pd.spec import StationSpec


SHAPES = ("ring", "star")
HOST_VARIABLE = "EAP_HOST"
"""Name of the host that this computer is, for commands without --host."""


@click.command()
@click.argument("file", type=PLANT_FILE, required=False)
@click.option(
    "--schema", is_flag=True, help="Instead: print the JSON Schema of plant files, for editors."
)
@click.option(
    "--security", is_flag=True, help="Also list what the plant leaves open to other hosts."
)
@json_option("Print one object: ok, all findings, and warnings.")
@click.pass_context
def check(
    ctx: click.Context, file: Path | None, schema: bool, security: bool, output: Renderer
) -> None:
    """Check the plant file or bus file FILE and report all errors.

    Exits with 2 when there is an error, with 1 when --security finds something open.  A warning
    names a part that runs but that some commands do not support.
    """
    if schema:
        if file is not None:
            raise click.UsageError("--schema excludes FILE", ctx)
        from eap.config.new_plant import SCHEMA

        write_text(SCHEMA.read_text(), end="")
        return
    if file is None:
        raise click.UsageError("nothing to check: give FILE, or --schema", ctx)
    from eap.ops.check import CheckedBus, check_file  # yaml; --help must not wait

    checked = check_file(file, security=security)
    found = checked.report
    for warning in found.warnings:
        output.remark(f"warning: {warning}")
    for finding in found.findings:
        output.remark(str(finding))
    for exposure in found.security or ():
        output.remark(f"open: {exposure}")
    if len(found.findings) > 1:
        what = "bus" if isinstance(checked, CheckedBus) else "plant"
        output.remark(
            f"{file}: {len(found.findings)} errors: the {what} cannot run; correct the file"
        )
    output.show(found, lambda _: _summary(file, checked))
    if found.findings:
        ctx.exit(ExitCode.UNUSABLE)
    if found.security:
        ctx.exit(ExitCode.FAILED)


def _summary(file: Path, checked: CheckedPlant | CheckedBus) -> Iterator[str]:
    """Yield the numbers of slaves, or of stations and PDs, of a file without errors."""
    from eap.ops.check import CheckedBus

    if isinstance(checked, CheckedBus):
        if checked.bus is not None:
            spec = checked.bus.spec
            yield f"{file}: no errors (bus {spec.bus}: {count(len(spec.slaves), 'slave')})"
        return
    plant = checked.plant
    if plant is None:
        return
    sent = sum(len(frame.pds) for station in plant.stations for frame in station.frames)
    received = sum(len(station.subscriptions) for station in plant.stations)
    yield (
        f"{file}: no errors (plant {plant.name}: {count(len(plant.stations), 'station')},"
        f" {count(sent, 'PD')} sent, {count(received, 'PD')} received)"
    )


@click.command()
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False, allow_dash=True))
@click.option(
    "--stations",
    "count",
    type=click.IntRange(2, 250),
    default=3,
    show_default=True,
    metavar="N",
    help="Number of stations.",
)
@click.option(
    "--ring", "shape", flag_value="ring", default="ring", help="Each station sends to the next."
)
@click.option(
    "--star",
    "shape",
    flag_value="star",
    help="The first station exchanges PDs with each other one.",
)
@click.option("--name", metavar="NAME", help="Name of the plant [default: the file's name]")
@click.option(
    "--address",
    default="127.0.1.{n}",
    show_default=True,
    metavar="PATTERN",
    help="Addresses of the stations: {n} is the station's number; 10.0.0.11 is the address of the"
    " first station, the others follow; ethernet://eth0 is the interface of each on its host.",
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
@click.option(
    "--from",
    "example",
    metavar="EXAMPLE",
    help="Copy an example plant instead, with its bus files: demo, valve, solar-line or another; an"
    " unknown name lists them.",
)
@click.option("--force", is_flag=True, help="Overwrite existing files.")
@json_option("Print one object: file, plant and stations, or the copied files.")
@click.pass_context
def new(
    ctx: click.Context,
    file: Path,
    count: int,
    shape: str,
    name: str | None,
    address: str,
    cycle_us: int,
    example: str | None,
    force: bool,
    output: Renderer,
) -> None:
    """Write the plant file FILE (- is stdout) with N stations in a ring or a star.

    Allocates names, NetIDs, addresses and PD IDs.  The file has explanatory comments, passes
    'eapctl check' and runs unchanged.  With --from, it is a copy of an example instead.
    """
    if example is not None:
        _refuse_shape(ctx)
        _copy_example(example, name, file, output, force=force)
        return
    from eap.config.new_plant import NewPlant, Shape, plant_text
    from eap.pd.rules import plant_name_of

    is_stdout = str(file) == "-"
    plant = name or ("plant" if is_stdout else plant_name_of(file.stem))
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
            raise click.UsageError("--json describes the written file: name a file instead of -")
        write_text(text, end="")
        return
    _write(file, text, force=force)
    created = NewPlant(str(file), plant, shape, count)
    output.show(
        created,
        lambda _: f"{file}: plant {plant}, {count} stations in a {shape}; eapctl run {file}",
    )


_OF_A_SHAPE = ("count", "shape", "address", "cycle_us")


def _refuse_shape(ctx: click.Context) -> None:
    """Raise UsageError if an option beside ``--from`` describes stations."""
    if any(ctx.get_parameter_source(each) is ParameterSource.COMMANDLINE for each in _OF_A_SHAPE):
        others = "--stations, --ring, --star, --address and --cycle"
        raise click.UsageError(f"--from copies an example: omit {others}", ctx)


def _copy_example(
    example: str, name: str | None, file: Path, output: Renderer, *, force: bool
) -> None:
    """Write the files of an example; those that are there already with this content stay."""
    from eap.config.examples import CopiedExample, read_example
    from eap.pd.rules import plant_name_of
    from eap.runtime.durable import whole_file

    plant = name or plant_name_of(file.stem)
    check_new_file(file, force=force)
    files = read_example(example, plant, file)
    others = list(files)[1:]
    for path in others:
        if path.exists() and path.read_bytes() != files[path] and not force:
            raise ConfigError(f"{path} exists: overwrite it with --force")
    for path, content in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as target:
            target.write(content)
    beside = list(map(str, others))
    created = CopiedExample(str(file), plant, example, beside)
    with_files = f", with {', '.join(beside)}" if beside else ""
    text = f"{file}: plant {plant}, a copy of the example {example}{with_files}; eapctl run {file}"
    output.show(created, lambda _: text)


def _write(file: Path, text: str, *, force: bool) -> None:
    from eap.runtime.durable import whole_file

    check_new_file(file, force=force)
    with whole_file(file) as target:
        target.write(text.encode())


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
        yield from _plan_summary(report)
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


def _plan_summary(report: PlanReport) -> Iterator[str]:

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
            yield f"  {number}. {step.station} {step.why}"


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


DEFAULT_CYCLE_US = 10_000
_OF_A_BLANK = "interface", "net_id", "cycle_us"


def _blank_options(command: CommandT) -> CommandT:
    blank = click.option(
        "--blank", metavar="NAME", help="Instead of PLANT: one station without configuration."
    )
    interface = click.option(
        "--interface",
        metavar="URI",
        help="Interface of the blank station's port eap0: udp://10.0.0.1 or ethernet://eth0.",
    )
    net_id = click.option(
        "--net-id",
        metavar="N",
        help="AMS NetID of that port: publisher ID of its frames and address of its dictionary.",
    )
    cycle = click.option(
        "--cycle",
        "cycle_us",
        callback=parse_cycle,
        metavar="MS",
        help="Device cycle of the blank station in milliseconds [default: 10]",
    )
    resume = click.option(
        "--resume",
        is_flag=True,
        help="Resume the last configuration of the blank station.",
    )
    return blank(interface(net_id(cycle(resume(command)))))


@click.command()
@click.argument("plant", type=PLANT_FILE, required=False)
@click.option(
    "--station",
    "stations",
    multiple=True,
    metavar="NAME",
    help="Run only this station; repeatable.",
)
@click.option(
    "--host",
    envvar=HOST_VARIABLE,
    default="",
    metavar="NAME",
    help="Run the stations of this host of PLANT; by default of the one whose name or address this"
    f" computer has, or that {HOST_VARIABLE} names.",
)
@_blank_options
@click.option(
    "--realtime/--no-realtime",
    default=True,
    show_default=True,
    help="Request SCHED_FIFO, locked memory and PM QoS; without permission the plant runs without"
    " them, and 'eapctl status' shows a warning.",
)
@click.option(
    "--priority",
    type=click.IntRange(1, 99),
    default=50,
    show_default=True,
    metavar="N",
    help="SCHED_FIFO priority of the engine.",
)
@click.option("--cpu", type=click.IntRange(0), metavar="N", help="Run the engine on this CPU only.")
@click.option(
    "--log",
    "log",
    type=click.Choice(("auto", "text", "json", "journal")),
    default="auto",
    show_default=True,
    help="Form of the log on stderr; journal sends entries with fields to journald, which auto does"
    " under systemd.",
)
@click.pass_context
def run(
    ctx: click.Context,
    plant: Path | None,
    stations: tuple[str, ...],
    host: str,
    realtime: bool,
    priority: int,
    cpu: int | None,
    log: str,
    blank: str | None,
    interface: str | None,
    net_id: str | None,
    cycle_us: int | None,
    resume: bool,
) -> None:
    """Run the stations of the plant file PLANT until Ctrl-C or SIGTERM.

    With --blank, run one station that has a single EAP port, in PREOP; 'eapctl od write', 'eapctl
    apply' or another tool configures it.

    Of a plant with hosts, the stations of one host run: docs/several-hosts.md.

    Prints one line {"ready": true, "stations": [...]} on stdout when each station has run its first
    cycle; messages go to stderr.  Exits with 2, and starts nothing, when the plant file has errors
    or this host lacks an address, interface or permission.
    """
    _check_form(ctx)
    from eap.runtime.handover import EngineOptions

    # Processes and sockets: imported here, so that --help does not wait for them.
    from eap.supervisor import process as supervisor
    from eap.supervisor.log_output import LogForm

    options = EngineOptions(realtime=realtime, priority=priority, cpu=-1 if cpu is None else cpu)
    if plant is not None:
        form = LogForm(log)
        ctx.exit(supervisor.run(plant, stations, host=host, options=options, log=form))
    station = _blank_plant(blank or "", interface or "", net_id or "", cycle_us or DEFAULT_CYCLE_US)
    form = LogForm(log)
    ctx.exit(supervisor.run_blank(station, options=options, resume=resume, log=form))


def _check_form(ctx: click.Context) -> None:
    """Raise UsageError unless the command line has one of the two forms."""
    given = {name for name in _OF_A_BLANK if ctx.params[name] is not None}
    has_plant = ctx.params["plant"] is not None
    if ctx.params["blank"] is None:
        if given or ctx.params["resume"]:
            names = "--interface, --net-id, --cycle and --resume"
            raise click.UsageError(f"{names} need --blank NAME", ctx)
        if not has_plant:
            raise click.UsageError("nothing to run: give PLANT, or --blank NAME", ctx)
    elif has_plant or ctx.params["stations"]:
        raise click.UsageError("--blank NAME excludes PLANT and --station", ctx)
    elif not {"interface", "net_id"} <= given:
        raise click.UsageError("--blank NAME needs --interface URI and --net-id N", ctx)


def _blank_plant(name: str, interface: str, net_id: str, cycle_us: int) -> Plant:
    """Return a plant of one blank station; raise ConfigError that names the wrong options."""
    from eap.config.load import INTERFACE_PATH, NET_ID_PATHS, blank

    result = blank(name, interface, net_id, cycle_us)
    if result.plant is not None:
        return result.plant
    options = {INTERFACE_PATH: "--interface"} | dict.fromkeys(NET_ID_PATHS, "--net-id")
    # A dict, since the router's NetID follows from the port's: both may report the same.
    lines = {
        f"{options.get(each.path, '--blank')}: {each.message}; expected {each.expected}": None
        for each in result.findings
    }
    raise ConfigError("\n".join(lines))
