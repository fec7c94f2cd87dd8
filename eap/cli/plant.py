"""Commands of a plant file: ``check``, ``new`` and ``run``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from eap.cli.group import ExitCode
from eap.cli.output import CommandT, Renderer, json_option, write_text
from eap.cli.params import PLANT_FILE, check_new_file, parse_cycle
from eap.errors import ConfigError
from eap.quantities import count

if TYPE_CHECKING:
    from eap.config.load import Plant
    from eap.ops.check import CheckedBus, CheckedPlant


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
    from eap.config.new_plant import CopiedExample, read_example
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
