"""``eapctl trace``: the way to a device, hop by hop."""

from __future__ import annotations

import click

from eap.cli.group import ExitCode
from eap.cli.output import write_json, write_tables
from eap.cli.params import examples, json_option, plant_option


@click.command(
    short_help="Show the way to a device, hop by hop, and where it ends.",
    epilog=examples(
        "eapctl trace island-03/bus0/1001",
        "eapctl trace 5.1.2.3.1.1:851 --via island-02",
    ),
)
@click.argument("targets", nargs=-1, required=True, metavar="TARGET…")
@click.option("--via", metavar="STATION", help="The router of this station asks, not of the first.")
@plant_option
@json_option("Print one object for each target; docs/trace.md explains its fields.")
@click.pass_context
def trace(
    ctx: click.Context, targets: tuple[str, ...], via: str | None, plant: str | None, as_json: bool
) -> None:
    """Ask each router on the way to TARGET where it passes requests on to, then TARGET itself.

    TARGET is STATION, STATION/PORT or STATION/PORT/SLAVE of the plant, or NETID:PORT.

    Exits with 1 when one of them is not reached; the last line says at which hop, and why.
    """
    from eap.appliance.commands import ams

    is_ok = True
    for target in targets:
        found = ams.trace(target, plant, via)
        is_ok = is_ok and found["ok"]
        if as_json:
            write_json(found)
            continue
        from eap.cli.trace_view import trace_tables  # rich; --help must not wait for it

        write_tables(trace_tables(found))
    if not is_ok:
        ctx.exit(ExitCode.FAILED)
