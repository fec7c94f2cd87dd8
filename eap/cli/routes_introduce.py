"""``eapctl routes introduce``: another router gets a route to one of ours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from eap.cli.group import ExitCode
from eap.cli.output import write_json, write_text
from eap.cli.params import ANSWER_MARGIN_S, examples, json_option, plant_option


@click.command(
    short_help="Ask another router for a route to a station.",
    epilog=examples(
        "eapctl routes introduce island-01 192.168.1.5 --user Administrator",
        "eapctl routes introduce island-01 192.168.1.5 --user Administrator --password-file pw",
    ),
)
@click.argument("station")
@click.argument("address")
@click.option("--name", default="", metavar="NAME", help="Of the route there; STATION without.")
@click.option("--user", default="", metavar="USER", help="User of the other system.")
@click.option(
    "--password-file",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    metavar="FILE",
    help="Its first line is the password; it is asked for without.",
)
@click.option(
    "--wait",
    "wait_ms",
    type=click.IntRange(10, 60_000),
    default=5000,
    show_default=True,
    metavar="MS",
    help="Patience for the answer.",
)
@plant_option
@json_option("Print one object: ok, result, text.")
@click.pass_context
def introduce(
    ctx: click.Context,
    station: str,
    address: str,
    name: str,
    user: str,
    password_file: Path | None,
    wait_ms: int,
    plant: str | None,
    as_json: bool,
) -> None:
    """Ask the router at ADDRESS, such as that of a PLC, for a route to the router of STATION.

    Most routers answer only whom they have a route to.  Asks by UDP 48899, where user and password
    are sent in clear.

    Exits with 1 when the other router refuses, or says nothing.
    """
    password = _password(user, password_file)
    from eap.appliance.commands.client import connect_station

    with connect_station(station, plant) as client:
        answer: dict[str, Any] = client.request_within(
            wait_ms / 1000 + ANSWER_MARGIN_S,
            "routes_introduce",
            station=station,
            address=address,
            name=name,
            user=user,
            password=password,
            wait_ms=wait_ms,
        )
    if as_json:
        write_json(answer)
    else:
        write_text(f"{address}: {answer['text']}")
    if not answer["ok"]:
        ctx.exit(ExitCode.FAILED)


def _password(user: str, file: Path | None) -> str:
    if file is not None:
        from eap.net.password import read_password_text

        return read_password_text(file)
    return click.prompt("Password", hide_input=True, err=True) if user else ""
