"""``eapctl sim``: simulated slaves that answer a master, and faults of simulated buses."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from eap.cli.completion import complete_bus
from eap.cli.group import LazyGroup
from eap.cli.output import CommandT, Renderer, json_option, write_json
from eap.cli.params import StationBus, examples, parse_port, plant_option
from eap.ids import InterfaceUri

_EXAMPLE = "such as power slave=drive for_ms=500"


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
        "fault": "eap.cli.sim:fault",
        "run": "eap.cli.sim:run",
        "set": "eap.cli.sim:set_value",
    },
)
def sim() -> None:
    """Run simulated slaves, and inject faults.

    To an EtherCAT master they behave like real slaves.
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
    help="Interface of the segment: ethernet://IFACE (needs CAP_NET_RAW) or udp://ADDRESS[:PORT].",
)
@click.option(
    "--second",
    callback=_parse_interface,
    metavar="URI",
    help="Second interface of a ring, of the same kind.",
)
@click.option("--faults", is_flag=True, help="Read faults from stdin, one JSON object per line.")
def run(bus: Path, interface: InterfaceUri, second: InterfaceUri | None, faults: bool) -> None:
    """Run the slaves of the bus file BUS.

    Prints one line {"ready": true, "slaves": n} on stdout when the slaves answer; Ctrl-C or SIGTERM
    ends the command.  docs/simulator.md describes bus files; config/buses has examples.
    """
    from eap.runtime import busfile  # yaml and sockets; --help must not wait
    from eap.segment import process as segment_process

    loaded = busfile.load_or_raise(bus)
    if second is not None and not (loaded.spec.ring and second.scheme == interface.scheme):
        raise click.UsageError(
            "--second needs an interface of the same kind and a bus file with ring: true"
        )
    # Only on request: a background process that reads its terminal is stopped by SIGTTIN.
    command_fd = sys.stdin.fileno() if faults else None
    segment_process.run(loaded, interface, write_json, second=second, command_fd=command_fd)


_TEXT_KEYS = frozenset(("object", "slave", "state"))


def parse_fault(words: tuple[str, ...]) -> dict[str, Any]:
    """Read a JSON object, or a kind and ``key=value``; raise UsageError for anything else."""
    if len(words) == 1 and words[0].lstrip().startswith("{"):
        import msgspec

        try:
            return msgspec.json.decode(words[0], type=dict[str, Any])
        except (ValueError, RecursionError) as exc:
            raise click.UsageError(f"not a fault in JSON: {exc}") from None
    kind, *rest = words
    fault: dict[str, Any] = {"kind": kind}
    for word in rest:
        key, equals, text = word.partition("=")
        if not key or not equals:
            raise click.UsageError(f"{word!r} is not key=value: a fault is written {_EXAMPLE}")
        # An object such as 0x1A00 looks like a number, and so may the name of a slave.
        value = text if key in _TEXT_KEYS else parse_value(text)
        # Either form of the key: options have a hyphen, bus files an underscore.
        fault[key.replace("-", "_")] = value
    return fault


def parse_value(text: str) -> bool | int | float | str:
    """Read true, false or a number, decimal or hexadecimal; any other word stays text."""
    if text in {"true", "false"}:
        return text == "true"
    try:
        return int(text, 0)
    except ValueError:
        pass
    try:
        return float(text)
    except ValueError:
        return text


def _place_argument(command: CommandT) -> CommandT:
    return click.argument(
        "bus", callback=_to_port, metavar="STATION/PORT", shell_complete=complete_bus
    )(command)


def _to_port(ctx: click.Context, param: click.Parameter, text: str) -> StationBus:
    port = parse_port(text)
    if port is None:
        raise click.BadParameter(f"{text!r} is not STATION/PORT, such as press/bus0", ctx, param)
    return port


@click.command(
    epilog=examples(
        "eapctl sim fault island-01/bus0 power slave=drive for_ms=500",
        "eapctl sim fault island-02/bus0 cut slave=sensor",
        "eapctl sim fault island-02/bus0 cut slave=sensor --end",
    )
)
@_place_argument
@click.argument("words", nargs=-1, required=True, metavar="JSON|KIND [KEY=VALUE]...")
@click.option("--end", is_flag=True, help="End this fault instead of starting it.")
@plant_option
@json_option("Print one object: what was sent.")
def fault(
    bus: StationBus, words: tuple[str, ...], end: bool, plant: str | None, output: Renderer
) -> None:
    """Inject a fault into a simulated bus of a running station.

    KIND is loss, delay, corrupt, wkc, cut, power, mailbox, foe, sdo, eeprom, tx-pdo, emergency,
    al-error, refuse or drift; most need slave=NAME and accept at_ms and for_ms.  docs/simulator.md
    describes each kind and its keys.
    """
    command = parse_fault(words) | ({"end": True} if end else {})
    _send(bus, command, plant)
    kind = command.get("kind")
    output.show(command, lambda _: f"{bus}: fault {kind} {'ended' if end else 'started'}")


@click.command(
    "set",
    context_settings={"ignore_unknown_options": True},
    epilog=examples(
        "eapctl sim set island-02/bus0 buttons start true",
        "eapctl sim set island-02/bus0 buttons start --release",
    ),
)
@_place_argument
@click.argument("slave")
@click.argument("entry")
@click.argument("value", required=False, metavar="[VALUE]")
@click.option("--release", is_flag=True, help="Release the entry; without VALUE.")
@plant_option
@json_option("Print one object: what was sent.")
def set_value(
    bus: StationBus,
    slave: str,
    entry: str,
    value: str | None,
    release: bool,
    plant: str | None,
    output: Renderer,
) -> None:
    """Force an entry of a simulated slave to VALUE until it is released.

    SLAVE is its name in the bus file, ENTRY the name of an input or another entry, or an object
    such as 0x6000:1.
    """
    if release == (value is not None):
        raise click.UsageError("expected one of VALUE and --release")
    where: dict[str, Any] = {"slave": slave, "entry": entry}
    if value is None:
        command = {"release": where}
    else:
        command = {"set": where | {"value": parse_value(value)}}
    _send(bus, command, plant)
    done = "released" if release else f"= {value}"
    output.show(command, lambda _: f"{bus}: {slave} {entry} {done}")


def _send(bus: StationBus, command: dict[str, Any], plant: str | None) -> None:
    from eap.ops.client import connect_station

    # By services, which hold the other end of the segment's command socket.
    with connect_station(bus.station, plant) as client:
        client.request("bus_fault", station=bus.station, port=bus.port, command=command)
