"""``eapctl run``: run a plant, some of its stations, or a blank station in the foreground."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from eap.cli.params import PLANT_FILE, CommandT, parse_cycle
from eap.errors import ConfigError

if TYPE_CHECKING:
    from eap.config.load import Plant

DEFAULT_CYCLE_US = 10_000
_OF_A_BLANK = "interface", "net_id", "cycle_us"


def _blank_options(command: CommandT) -> CommandT:
    blank = click.option(
        "--blank", metavar="NAME", help="In place of PLANT: a station without any configuration."
    )
    interface = click.option(
        "--interface",
        metavar="URI",
        help="Of the blank station's port eap0, such as udp://10.0.0.1 or ethernet://eth0.",
    )
    net_id = click.option(
        "--net-id",
        metavar="N",
        help="AMS NetID of that port: publisher ID of its frames, address of its dictionary.",
    )
    cycle = click.option(
        "--cycle",
        "cycle_us",
        callback=parse_cycle,
        metavar="MS",
        help="Device cycle of the blank station in milliseconds; 10 unless given.",
    )
    resume = click.option(
        "--resume",
        is_flag=True,
        help="Let the blank station go on with what it was configured to be when it last ran.",
    )
    return blank(interface(net_id(cycle(resume(command)))))


@click.command(short_help="Run a plant, or some of its stations.")
@click.argument("plant", type=PLANT_FILE, required=False)
@click.option(
    "--station",
    "stations",
    multiple=True,
    metavar="NAME",
    help="Run only this station; may be given several times.",
)
@_blank_options
@click.option(
    "--realtime/--no-realtime",
    default=True,
    show_default=True,
    help="Ask for SCHED_FIFO, locked memory and PM QoS; without permission the plant runs all the"
    " same, and status says so.",
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
@click.pass_context
def run(
    ctx: click.Context,
    plant: Path | None,
    stations: tuple[str, ...],
    realtime: bool,
    priority: int,
    cpu: int | None,
    blank: str | None,
    interface: str | None,
    net_id: str | None,
    cycle_us: int | None,
    resume: bool,
) -> None:
    """Run the stations of the plant file PLANT until Ctrl-C or SIGTERM.

    With --blank, run one station that has an EAP port and nothing else, in PREOP: 'eapctl od
    write', 'eapctl apply' or another tool configures it.

    When each has run its first cycle, one line {"ready": true, "stations": [...]} appears on
    stdout; messages go to stderr.  Exits with 2, and starts nothing, when the file or this machine
    is not fit.
    """
    _check_form(ctx)
    from eap.runtime.handover import EngineOptions

    # Processes and sockets: --help must not wait for them.
    from eap.supervisor import process as supervisor

    options = EngineOptions(realtime=realtime, priority=priority, cpu=-1 if cpu is None else cpu)
    if plant is not None:
        ctx.exit(supervisor.run(plant, stations, options=options))
    station = _blank_plant(blank or "", interface or "", net_id or "", cycle_us or DEFAULT_CYCLE_US)
    ctx.exit(supervisor.run_blank(station, options=options, resume=resume))


def _check_form(ctx: click.Context) -> None:
    """Raise UsageError unless the command line has one of the two forms."""
    given = {name for name in _OF_A_BLANK if ctx.params[name] is not None}
    has_plant = ctx.params["plant"] is not None
    if ctx.params["blank"] is None:
        if given or ctx.params["resume"]:
            names = "--interface, --net-id, --cycle and --resume"
            raise click.UsageError(f"{names} go with --blank NAME", ctx)
        if not has_plant:
            raise click.UsageError("say what to run: PLANT, or --blank NAME", ctx)
    elif has_plant or ctx.params["stations"]:
        raise click.UsageError("--blank NAME takes the place of PLANT and --station", ctx)
    elif not {"interface", "net_id"} <= given:
        raise click.UsageError("--blank NAME needs --interface URI and --net-id N", ctx)


def _blank_plant(name: str, interface: str, net_id: str, cycle_us: int) -> Plant:
    """Return a plant of one blank station; raise ConfigError that names the wrong options."""
    from eap.config.load import INTERFACE_PATH, NET_ID_PATHS, blank

    result = blank(name, interface, net_id, cycle_us)
    if result.plant is not None:
        return result.plant
    options = {INTERFACE_PATH: "--interface"} | dict.fromkeys(NET_ID_PATHS, "--net-id")
    lines = {
        f"{options.get(each.path, '--blank')}: {each.message}; expected {each.expected}": None
        for each in result.findings
    }
    raise ConfigError("\n".join(lines))
