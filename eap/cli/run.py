"""``eapctl run``: run a plant, or some of its stations, in the foreground."""

from __future__ import annotations

from pathlib import Path

import click

from eap.cli.params import PLANT_FILE


@click.command(short_help="Run a plant, or some of its stations.")
@click.argument("plant", type=PLANT_FILE)
@click.option(
    "--station",
    "stations",
    multiple=True,
    metavar="NAME",
    help="Run only this station; may be given several times.",
)
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
    plant: Path,
    stations: tuple[str, ...],
    realtime: bool,
    priority: int,
    cpu: int | None,
) -> None:
    """Run the stations of the plant file PLANT until Ctrl-C or SIGTERM.

    When each has run its first cycle, one line {"ready": true, "stations": [...]} appears on
    stdout; messages go to stderr.  Exits with 2, and starts nothing, when the file or this machine
    is not fit.
    """
    from eap.appliance import supervisor  # processes and sockets; --help must not wait for them
    from eap.appliance.handover import EngineOptions

    options = EngineOptions(realtime=realtime, priority=priority, cpu=-1 if cpu is None else cpu)
    ctx.exit(supervisor.run(plant, stations, options=options))
