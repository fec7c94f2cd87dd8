"""``eapctl state``: the state of a station's EAP device, or of a slave behind its bus."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from eap.cli.group import ExitCode
from eap.cli.od_params import target_argument
from eap.cli.output import write_json, write_text
from eap.cli.params import json_option
from eap.errors import ControlError

if TYPE_CHECKING:
    from eap.appliance.commands.od_target import Target

STATES = ("PREOP", "SAFEOP", "OP")
_OF_SLAVES = ("INIT", *STATES, "BOOT")


@click.command(short_help="Show or request the state of a station.")
@target_argument
@click.argument(
    "wanted",
    required=False,
    type=click.Choice(_OF_SLAVES, case_sensitive=False),
    metavar="[PREOP|SAFEOP|OP]",
)
@json_option("Print one object: state, and error or null.")
@click.pass_context
def state(ctx: click.Context, wanted: str | None, target: Target, as_json: bool) -> None:
    """Show the state of TARGET, or bring it to another one.

    TARGET is STATION or STATION/PORT: PREOP takes configuration, SAFEOP sends, OP sends and
    receives.  A slave is STATION/PORT/SLAVE, and has INIT and BOOT too; so has a bus port, which
    stands for all its slaves.  What does not run here, by name or NETID:PORT, is asked through
    routes.

    Exits with 1 when the state was refused, which leaves the station where it was.
    """
    wanted = wanted and wanted.upper()
    answer = _ask(target, wanted)
    is_refused = wanted is not None and answer["state"] != wanted
    if as_json:
        write_json({"target": str(target)} | answer)
    else:
        write_text(f"{target}: {answer['state'] or 'no answer'}")
    error = answer["error"]
    if error and not as_json:
        what = f"{wanted} was refused" if is_refused else "the last request was refused"
        click.echo(f"{target}: {what}: {_error_text(error)}", err=True)
    if is_refused:
        ctx.exit(ExitCode.FAILED)


def _ask(target: Target, wanted: str | None) -> dict[str, Any]:
    if not target.is_here:
        return _of_far(target, wanted)
    if wanted and not target.port and wanted not in STATES:
        raise click.UsageError(f"{wanted} cannot be requested: expected {', '.join(STATES)}")
    return _of_slave(target, wanted) if target.slave else _of_station(target, wanted)


def _of_far(target: Target, wanted: str | None) -> dict[str, Any]:
    from eap.appliance.commands.ams_device import open_ams
    from eap.appliance.commands.ams_state import read_state, request_state

    with open_ams(str(target), target.plant) as device:
        return request_state(device, wanted) if wanted else read_state(device)


def _of_station(target: Target, wanted: str | None) -> dict[str, Any]:
    from eap.appliance.commands.client import connect_station
    from eap.appliance.control import ErrorCode

    asked = {"target": str(target)} | ({"state": wanted} if wanted else {})
    try:
        with connect_station(target.station, target.plant) as client:
            answer: dict[str, Any] = client.request("request_state" if wanted else "state", **asked)
    except ControlError as exc:
        if exc.code != ErrorCode.UNKNOWN_NAME or not target.port:
            raise
        return _of_far(target, wanted)  # a bus port has a master, or there is no such port
    return answer


def _of_slave(target: Target, wanted: str | None) -> dict[str, Any]:
    from eap.appliance.commands.bus_info import state_rows
    from eap.appliance.commands.bus_running import open_running

    with open_running(target.station, target.port, target.plant) as bus:
        (row,) = state_rows(bus, target.slave, wanted)
    error = {"code": row["code"], "text": row["reason"]} if row["reason"] else None
    return {"state": row["state"], "error": error}


def _error_text(error: dict[str, Any]) -> str:
    code = f" (0x{error['code']:04X})" if error["code"] else ""
    return f"{error['text']}{code}"
