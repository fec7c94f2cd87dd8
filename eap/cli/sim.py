"""``eapctl sim run``: simulated slaves that answer a master."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from eap.cli.group import LazyGroup
from eap.cli.output import write_json
from eap.cli.params import examples
from eap.ids import InterfaceUri


def _parse_interface(
    ctx: click.Context, param: click.Parameter, text: str | None
) -> InterfaceUri | None:
    try:
        return None if text is None else InterfaceUri.parse(text)
    except ValueError as exc:
        raise click.BadParameter(str(exc), ctx, param) from None


@click.group(
    cls=LazyGroup,
    commands_at={
        "fault": "eap.cli.sim_fault:fault",
        "run": "eap.cli.sim:run",
        "set": "eap.cli.sim_fault:set_value",
    },
)
def sim() -> None:
    """Run simulated slaves, and let things happen.

    A master of the EtherCAT device protocol takes them for real ones.
    """


@click.command(
    epilog=examples("eapctl sim run config/buses/drive.yaml --interface udp://127.0.4.1")
)
@click.argument("bus", type=click.Path(dir_okay=False, path_type=Path))
@click.option(
    "--interface",
    required=True,
    callback=_parse_interface,
    metavar="URI",
    help="Where to answer: ethernet://IFACE (needs CAP_NET_RAW) or udp://ADDRESS[:PORT].",
)
@click.option(
    "--second",
    callback=_parse_interface,
    metavar="URI",
    help="The other line of a ring: ethernet://IFACE.",
)
@click.option("--faults", is_flag=True, help="Take faults as JSON, one a line, from stdin.")
def run(bus: Path, interface: InterfaceUri, second: InterfaceUri | None, faults: bool) -> None:
    """Run the slaves of the bus file BUS.

    When they answer, one line {"ready": true, "slaves": n} appears on stdout; Ctrl-C or SIGTERM
    ends them.  docs/simulator.md describes bus files; config/buses has some to start from.
    """
    from eap.appliance import busfile  # yaml and sockets; --help must not wait
    from eap.appliance.segment import process as segment_process

    loaded = busfile.load_or_raise(bus)
    if second is not None and not (loaded.spec.ring and second.scheme == "ethernet"):
        raise click.UsageError(
            "--second is an ethernet:// interface, for a bus file with ring: true"
        )
    command_fd = sys.stdin.fileno() if faults else None
    segment_process.run(loaded, interface, write_json, second=second, command_fd=command_fd)
