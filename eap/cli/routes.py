"""``eapctl routes``: which station is reached by which way, and how these ways are doing."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import click

from eap.cli.group import ExitCode, LazyGroup
from eap.cli.output import write_json, write_tables, write_text
from eap.cli.params import ANSWER_MARGIN_S, examples, json_option, plant_option
from eap.errors import EnvironmentalError

if TYPE_CHECKING:
    from eap.appliance.control_routes import TestResult


@click.group(
    cls=LazyGroup,
    commands_at={
        "add": "eap.cli.routes:add",
        "export": "eap.cli.routes_file:export",
        "import": "eap.cli.routes_file:import_routes",
        "introduce": "eap.cli.routes_introduce:introduce",
        "list": "eap.cli.routes:list_all",
        "remove": "eap.cli.routes:remove",
        "scan": "eap.cli.routes_scan:scan",
        "test": "eap.cli.routes:test",
    },
    short_help="Show, add, remove and test routes; without a command: a live view.",
    invoke_without_command=True,
    epilog=examples(
        "eapctl routes",
        "eapctl routes list island-01",
        "eapctl routes test island-01 island-03",
        "eapctl routes add island-01 press 5.1.2.3.1.1 --via ams-tcp:192.168.1.5",
    ),
)
@plant_option
@click.pass_context
def routes(ctx: click.Context, plant: str | None) -> None:
    """Show the routes and connections of the routers of running stations, live.

    In a terminal and without a command: a table to look at and to work with, by keyboard or mouse.
    Elsewhere it is printed once, as by 'eapctl routes list'.
    """
    if ctx.invoked_subcommand is not None:
        if plant:
            raise click.UsageError("--plant goes behind the command")
        return
    if not is_terminal():
        ctx.invoke(list_all, plant=plant, station=None, match="", as_json=False)
        return
    _run_view(plant)


def is_terminal() -> bool:
    """Say whether somebody sits before a screen."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def _run_view(plant: str | None) -> None:
    try:
        from eap.cli.routes_tui.app import run_view
    except ModuleNotFoundError as exc:
        if exc.name != "textual":
            raise
        raise EnvironmentalError(
            "the live view needs Textual: pip install 'eap-appliance[tui]' brings it along;"
            " 'eapctl routes list' shows the same once"
        ) from None
    run_view(plant)


@click.command("list", short_help="List routes and connections.")
@click.argument("station", required=False, metavar="[STATION]")
@click.option(
    "--match",
    default="",
    metavar="TEXT",
    help="Only routes with TEXT in name, NetID, door, address, origin or state.",
)
@plant_option
@json_option("Print one object: stations, each with routes, connections, requests, warnings.")
def list_all(station: str | None, match: str, plant: str | None, as_json: bool) -> None:
    """List the routes and connections of STATION, or of all running stations."""
    from eap.appliance.commands.route_lists import list_routes

    found = list_routes(plant, station, match, requests=50 if as_json else 0)
    stations = [row for each in found for row in each.stations]
    if as_json:
        write_json({"stations": stations})
        return
    from eap.cli.routes_view import routes_tables

    write_tables(routes_tables(stations))


@click.command(short_help="Add a route, which is kept until it is removed.")
@click.argument("station")
@click.argument("name")
@click.argument("net_id", required=False, default="", metavar="[NETID]")
@click.option(
    "--via",
    required=True,
    metavar="VIA",
    help="STATION/PORT of the plant, or ams-tcp:HOST[:PORT], udp:ADDRESS, tcp:ADDRESS,"
    " ethernet:MAC, mqtt:NETWORK.",
)
@click.option("--port", default="", metavar="PORT", help="EAP port of STATION to leave by.")
@click.option(
    "--octets",
    type=click.Choice(["6", "5", "4", "0"]),
    default="4",
    show_default=True,
    help="How many octets of NETID have to match; 0 takes all that no other route does.",
)
@click.option("--virtual", default="", metavar="NETID", help="NetID that it has here (NAT).")
@click.option("--unidirectional", is_flag=True, help="Nothing may be asked from there.")
@click.option(
    "--timeout",
    "timeout_ms",
    type=click.IntRange(1, 600_000),
    metavar="MS",
    help="How long an answer may take.",
)
@click.option("--no-probe", is_flag=True, help="Do not ask the next hop whether it is alive.")
@plant_option
@json_option("Print one object: route and warnings.")
def add(
    station: str,
    name: str,
    net_id: str,
    via: str,
    port: str,
    octets: str,
    virtual: str,
    unidirectional: bool,
    timeout_ms: int | None,
    no_probe: bool,
    plant: str | None,
    as_json: bool,
) -> None:
    """Add a route to the router of STATION: to NAME with NETID, by way of VIA.

    NETID may be left out when NAME is a station of the plant.  A route of the plant file goes
    before one that was added; 'eapctl routes test STATION NAME' shows whether it works.
    """
    answer = _ask(
        station, plant, "routes_add", name=name, net_id=net_id, via=via, port=port,
        octets=int(octets), virtual=virtual, unidirectional=unidirectional,
        timeout_ms=timeout_ms or 0, probed=not no_probe,
    )  # fmt: skip
    if as_json:
        write_json(answer)
        return
    from eap.aoe.way import Way

    route = answer["route"]
    way = Way(route["door"], route["address"])
    write_text(f"{station}: added {name} ({route['net_id']}, {way})")
    for warning in answer["warnings"]:
        click.echo(f"{station}: {warning}", err=True)


@click.command(short_help="Remove a route that was added.")
@click.argument("station")
@click.argument("route")
@click.option("--door", default="", help="Of several with one name or NetID the one by this door.")
@click.option("--address", default="", help="Likewise, the one to this address.")
@plant_option
@json_option("Print one object: the route.")
def remove(
    station: str, route: str, door: str, address: str, plant: str | None, as_json: bool
) -> None:
    """Remove ROUTE, a name or NetID, from the router of STATION.

    Routes of the plant file are removed there; those that were learned go by themselves.
    """
    answer = _ask(station, plant, "routes_remove", route=route, door=door, address=address)
    if as_json:
        write_json(answer)
        return
    row = answer["route"]
    write_text(f"{station}: removed {row['name']} ({row['net_id']}, {row['address']})")


@click.command(short_help="Measure the way to stations and back.")
@click.argument("station", required=False, metavar="[STATION]")
@click.argument("targets", nargs=-1, metavar="[TARGET]...")
@click.option(
    "--timeout",
    "timeout_ms",
    type=click.IntRange(1, 60_000),
    default=5000,
    show_default=True,
    metavar="MS",
    help="Patience for each answer.",
)
@plant_option
@json_option("Print one object a target and line.")
@click.pass_context
def test(
    ctx: click.Context,
    station: str | None,
    targets: tuple[str, ...],
    timeout_ms: int,
    plant: str | None,
    as_json: bool,
) -> None:
    """Ask each TARGET for its state, by way of the router of STATION, and measure the time.

    TARGET is the name of a route, a NetID, or a name of the plant (STATION, STATION/PORT,
    STATION/PORT/SLAVE); all routes without one, of all running stations without STATION.  Says in
    words what is wrong, where, and what to do.

    Exits with 1 when one of them does not answer; without a TARGET a client that does not listen
    is no failure.
    """
    from eap.appliance.commands.route_lists import list_routes

    chosen = [(station, target) for target in targets if station]
    clients: set[tuple[str, str]] = set()
    if not chosen:
        found = [row for each in list_routes(plant, station) for row in each.stations]
        chosen = [(row.station, name) for row in found for name in _names(row.routes)]
        clients = {
            (row.station, route.net_id)
            for row in found
            for route in row.routes
            if route.state == "client"
        }
    results = [(each, _test(each, target, timeout_ms, plant)) for each, target in chosen]
    failed = [
        place
        for place, (_, result) in zip(chosen, results, strict=True)
        if not result.ok and place not in clients
    ]
    if as_json:
        for name, result in results:
            write_json({"station": name} | _plain(result))
    else:
        from eap.cli.routes_view import result_table

        write_tables([result_table(results)])
    if failed:
        ctx.exit(ExitCode.FAILED)


def _names(routes: list[Any]) -> list[str]:
    """Return what to ask to try all routes: their NetIDs; a default route leads to none."""
    return list(dict.fromkeys(row.net_id for row in routes if row.octets))


def _test(station: str, target: str, timeout_ms: int, plant: str | None) -> TestResult:
    from eap.appliance.control_routes import TestResult, read_document

    patience_s = timeout_ms / 1000 + ANSWER_MARGIN_S
    answer = _ask(station, plant, "routes_test", patience_s, target=target, timeout_ms=timeout_ms)
    return read_document(answer, TestResult)


def _plain(result: TestResult) -> dict[str, Any]:
    import msgspec

    document: dict[str, Any] = msgspec.to_builtins(result)
    return document


def _ask(
    station: str, plant: str | None, method: str, patience_s: float = 10.0, **params: Any
) -> Any:
    from eap.appliance.commands.client import connect_station

    with connect_station(station, plant) as client:
        return client.request_within(patience_s, method, station=station, **params)
