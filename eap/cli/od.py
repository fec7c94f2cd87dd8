"""``eapctl od`` and ``state``: dictionary and state of a device, local or remote."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from eap.cli.completion import complete_target
from eap.cli.group import CommandGroup, ExitCode
from eap.cli.output import Renderer, TextTable, json_option
from eap.cli.params import parse_entry, parse_octets, parse_type, plant_option
from eap.errors import ControlError

if TYPE_CHECKING:
    from eap.codec.datatypes import DataType
    from eap.control.device import StateAnswer
    from eap.ids import ObjectId
    from eap.ops.od import OdDumpEntry, OdObjectRow
    from eap.ops.od_devices import Target

STATES = ("PREOP", "SAFEOP", "OP")
_OF_SLAVES = ("INIT", *STATES, "BOOT")

_TYPE = click.option(
    "--type",
    "kind",
    type=parse_type,
    metavar="TYPE",
    help="Data type, such as UINT or STRING(16) [default: as the device describes it]",
)


def target_argument(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add TARGET as the first argument and ``--plant``; the function gets *target*."""

    @wraps(command)
    def with_target(*args: Any, target: str, plant: str | None, **params: Any) -> Any:
        return command(*args, target=_target(target, plant), **params)

    return click.argument("target", metavar="TARGET", shell_complete=complete_target)(
        plant_option(with_target)
    )


def _target(text: str, plant: str | None) -> Target:
    from eap.ops.od_devices import Target

    try:
        return Target.parse(text)._replace(plant=plant)
    except ValueError as exc:
        raise click.UsageError(str(exc)) from None


@click.group(cls=CommandGroup)
def od() -> None:
    """Read and write the object dictionary of a device.

    TARGET is STATION or STATION/PORT for an EAP port of a station, STATION/router for its router,
    STATION/PORT for the master of a bus port, and STATION/PORT/SLAVE for a slave of that bus.  A
    remote device, given by name or as NETID:PORT, is reached through routes.  INDEX and SUB are
    hexadecimal, with or without 0x (0xD000:07, D000:7).
    """


@od.command("list")
@target_argument
@json_option("Print one object per line.")
def list_objects(target: Target, output: Renderer) -> None:
    """List all objects with their names."""
    from eap.ops.od import object_rows
    from eap.ops.od_devices import open_device

    with open_device(target) as device:
        rows = list(object_rows(device.objects()))
    output.show_rows(rows, _object_table)


def _object_table(rows: Iterable[OdObjectRow]) -> Iterator[TextTable]:
    from msgspec.structs import replace

    from eap.cli.bus_view import object_table
    from eap.cli.od_text import object_name

    yield from object_table(replace(row, name=object_name(row.name, row.label)) for row in rows)


@od.command()
@target_argument
@click.argument("entry", type=parse_entry, metavar="INDEX[:SUB]")
@_TYPE
@click.option(
    "--complete", is_flag=True, help="Complete access: the whole object, from INDEX:0 or INDEX:1."
)
@json_option("Print one object.")
def read(
    entry: ObjectId, kind: DataType | None, complete: bool, target: Target, output: Renderer
) -> None:
    """Read an entry, or a whole object."""
    from eap.cli.od_text import object_lines, value_line
    from eap.ops.od import read_entry, read_object
    from eap.ops.od_devices import open_device

    with open_device(target) as device:
        if complete:
            output.show(read_object(device, *entry), object_lines)
        else:
            output.show(read_entry(device, *entry, kind), value_line)


# A negative VALUE such as -5 is no option.
@od.command(context_settings={"ignore_unknown_options": True})
@target_argument
@click.argument("entry", required=False, metavar="[INDEX[:SUB]]")
@click.argument("value", required=False, metavar="[VALUE]")
@_TYPE
@click.option(
    "--hex", "octets", type=parse_octets, metavar="DIGITS", help="Raw bytes, instead of VALUE."
)
@click.option(
    "--complete",
    is_flag=True,
    help="Complete access: the whole object, from INDEX:0 or INDEX:1; needs --hex.",
)
@click.option(
    "--from",
    "file",
    type=click.Path(path_type=Path, dir_okay=False, allow_dash=True),
    metavar="FILE",
    help="All entries of FILE, the output of 'od dump', in the order that the device needs.",
)
@json_option("Print one object: what was written.")
def write(
    entry: str | None,
    value: str | None,
    kind: DataType | None,
    octets: bytes | None,
    complete: bool,
    file: Path | None,
    target: Target,
    output: Renderer,
) -> None:
    """Write an entry, a whole object, or all entries of a file.

    VALUE is a literal of the entry's type: 12, 0xC, -1.5e3, true, text, hexadecimal digits for raw
    bytes, and 127.0.1.1.2.1, 01:01:05:04:00:00 or 10.0.0.1 for an address.

    A station accepts configuration in PREOP only ('eapctl state TARGET PREOP').
    """
    if file is not None:
        if entry or value or octets is not None or kind is not None or complete:
            raise click.UsageError("--from FILE has entries and values: omit all other arguments")
        _load(target, file, output)
        return
    place = _entry_to_write(entry, value, octets, complete=complete)
    from eap.cli.od_text import octets_line, value_line
    from eap.ops.od import write_entry, write_octets
    from eap.ops.od_devices import open_device

    with open_device(target) as device:
        if octets is not None:
            output.show(write_octets(device, *place, octets, complete=complete), octets_line)
        else:
            output.show(write_entry(device, *place, value or "", kind), value_line)


def _load(target: Target, file: Path, output: Renderer) -> None:
    """Write the entries of *file* to *target*."""
    from eap.cli.od_text import load_line, read_file
    from eap.ops import od as ops
    from eap.ops.od_devices import open_device

    entries = read_file(file)
    with open_device(target) as device:
        done = ops.load(device, entries)
    output.show(ops.OdLoadResult(str(target), *done), load_line)


@od.command()
@target_argument
@json_option("Print one object per entry and line.")
def dump(target: Target, output: Renderer) -> None:
    """Print all entries of all objects, in the form that 'od write --from' reads."""
    from eap.cli.od_text import dump_lines
    from eap.ops.od import dump_rows
    from eap.ops.od_devices import open_device

    def lines(rows: Iterable[OdDumpEntry]) -> Iterator[str]:
        return dump_lines(str(target), rows)

    with open_device(target) as device:
        output.show_rows(dump_rows(device.contents()), lines)


def _entry_to_write(
    entry: str | None, value: str | None, octets: bytes | None, *, complete: bool
) -> ObjectId:
    """Return index and subindex; raise UsageError unless exactly one value is given."""
    if entry is None:
        raise click.UsageError("nothing to write: give INDEX[:SUB] VALUE, or --from FILE")
    if (value is None) == (octets is None):
        raise click.UsageError("expected one value: VALUE or --hex DIGITS")
    if complete and octets is None:
        raise click.UsageError("--complete writes raw bytes: give them with --hex DIGITS")
    return parse_entry(entry)


@click.command()
@target_argument
@click.argument(
    "wanted",
    required=False,
    type=click.Choice(_OF_SLAVES, case_sensitive=False),
    metavar="[PREOP|SAFEOP|OP]",
)
@json_option("Print one object: state, and error or null.")
@click.pass_context
def state(ctx: click.Context, wanted: str | None, target: Target, output: Renderer) -> None:
    """Show the state of TARGET, or request another one.

    TARGET is STATION or STATION/PORT.  In PREOP a station accepts configuration, in SAFEOP it
    sends, in OP it sends and receives.  STATION/PORT/SLAVE is a slave, which has INIT and BOOT too;
    a bus port means all its slaves.  A remote device, given by name or as NETID:PORT, is reached
    through routes.

    Exits with 1 when the request is refused; the station then keeps its state.
    """
    from eap.control.device import TargetState

    wanted = wanted and wanted.upper()
    answer = _state_of(target, wanted)
    is_refused = wanted is not None and answer.state != wanted
    output.show(
        TargetState(str(target), answer.state, answer.error),
        lambda found: f"{target}: {found.state or 'no answer'}",
    )
    if answer.error is not None:
        code = f" (0x{answer.error.code:04X})" if answer.error.code else ""
        text = f"{answer.error.text}{code}"
        if not target.slave:
            # A station keeps the error of its last request, also when its state is only read.
            text = f"{wanted if is_refused else 'the last request'} was refused: {text}"
        output.remark(f"{target}: {text}")
    if is_refused:
        ctx.exit(ExitCode.FAILED)


def _state_of(target: Target, wanted: str | None) -> StateAnswer:
    if not target.is_here:
        return _state_by_ads(target, wanted)
    if wanted and not target.port and wanted not in STATES:
        raise click.UsageError(f"{wanted} cannot be requested: expected {', '.join(STATES)}")
    return _state_of_slave(target, wanted) if target.slave else _state_of_station(target, wanted)


def _state_by_ads(target: Target, wanted: str | None) -> StateAnswer:
    from eap.ops.routing import open_ams, read_state, request_state

    with open_ams(str(target), target.plant) as device:
        return request_state(device, wanted) if wanted else read_state(device)


def _state_of_station(target: Target, wanted: str | None) -> StateAnswer:
    from eap.control.device import REQUEST_STATE, STATE
    from eap.control.protocol import ErrorCode
    from eap.ops.client import connect_station

    try:
        with connect_station(target.station, target.plant) as client:
            if wanted:
                return client.call(REQUEST_STATE, target=str(target), state=wanted)
            return client.call(STATE, target=str(target))
    except ControlError as exc:
        if exc.code != ErrorCode.UNKNOWN_NAME or not target.port:
            raise
        return _state_by_ads(target, wanted)  # the master of a bus port answers by ADS


def _state_of_slave(target: Target, wanted: str | None) -> StateAnswer:
    from eap.control.device import StateAnswer, StateError
    from eap.ops.bus_info import slave_states
    from eap.ops.bus_running import open_running

    with open_running(target.station, target.port, target.plant) as bus:
        (row,) = slave_states(bus, target.slave, wanted).slaves
    return StateAnswer(row.state, StateError(row.code, row.reason) if row.reason else None)
