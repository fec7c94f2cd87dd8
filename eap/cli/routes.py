"""``eapctl routes``: routes of the routers of running stations."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from eap.cli.completion import complete_station
from eap.cli.group import ExitCode, LazyGroup
from eap.cli.output import Renderer, json_option, write_text
from eap.cli.params import ANSWER_MARGIN_S, examples, ms_option, plant_option
from eap.errors import ControlError

if TYPE_CHECKING:
    from eap.control.routes import ImportRow, NeighbourRow, TestResult

_IMPORT_S = 60.0
"""Time for a file with many routes, each of which is written to disk."""
_FILE = click.Path(path_type=Path, dir_okay=False, allow_dash=True)


@click.group(
    cls=LazyGroup,
    commands_at={
        "add": "eap.cli.routes:add",
        "add-remote": "eap.cli.routes:add_remote",
        "export": "eap.cli.routes:export",
        "import": "eap.cli.routes:import_routes",
        "list": "eap.cli.routes:list_all",
        "remove": "eap.cli.routes:remove",
        "scan": "eap.cli.routes:scan",
        "test": "eap.cli.routes:test",
    },
    former_names={"introduce": "add-remote"},
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
    """Show the AMS routes and connections of running stations.

    Without a command, a terminal shows 'eapctl top' with its view of routes; otherwise the table is
    printed once, like 'eapctl routes list'.
    """
    if ctx.invoked_subcommand is not None:
        if plant:
            # The group has the option for the view alone; each command has one of its own.
            raise click.UsageError("--plant stands before its command: write it after the command")
        return
    if not is_terminal():
        ctx.invoke(list_all, plant=plant, station=None, match="", output=Renderer(is_json=False))
        return
    from eap.cli.top import run_app

    run_app(plant or "", tab="routes", may_write=True, instead="'eapctl routes list'")


def is_terminal() -> bool:
    """Return whether stdin and stdout are a terminal."""
    return sys.stdin.isatty() and sys.stdout.isatty()


@click.command("list", short_help="List routes and connections.")
@click.argument("station", required=False, metavar="[STATION]", shell_complete=complete_station)
@click.option(
    "--match",
    default="",
    metavar="TEXT",
    help="Only routes with TEXT in name, NetID, transport, address, origin or state.",
)
@plant_option
@json_option("Print one object: stations, each with routes, connections, requests, warnings.")
def list_all(station: str | None, match: str, plant: str | None, output: Renderer) -> None:
    """List the routes and connections of STATION, or of all running stations."""
    from eap.cli.routes_view import routes_view
    from eap.ops.routing import RouterList, list_routes

    silent: list[ControlError] = []
    requests = 50 if output.is_json else 0
    found = list_routes(plant, station, match, requests=requests, silent=silent)
    output.show(RouterList([row for each in found for row in each.stations]), routes_view)
    if silent:
        raise silent[0]


@click.command(short_help="Add a persistent route.")
@click.argument("station", shell_complete=complete_station)
@click.argument("name")
@click.argument("net_id", required=False, default="", metavar="[NETID]")
@click.option(
    "--via",
    required=True,
    metavar="VIA",
    help="STATION/PORT of the plant, or ams-tcp:HOST[:PORT], ams-tls:HOST[:PORT], udp:ADDRESS,"
    " tcp:ADDRESS,"
    " ethernet:MAC, mqtt:NETWORK.",
)
@click.option("--port", default="", metavar="PORT", help="EAP port of STATION to send from.")
@click.option(
    "--octets",
    type=click.Choice(["6", "5", "4", "0"]),
    default="4",
    show_default=True,
    help="Number of NETID bytes that must match; 0 is a default route.",
)
@click.option(
    "--virtual",
    default="",
    metavar="NETID",
    help="Virtual NetID of NAME at STATION (NAT).",
)
@click.option("--unidirectional", is_flag=True, help="Refuse requests from this next hop.")
@click.option(
    "--timeout",
    "timeout_ms",
    type=click.IntRange(1, 600_000),
    metavar="MS",
    help="Timeout of an answer.",
)
@click.option("--no-probe", is_flag=True, help="Do not probe the next hop.")
@click.option(
    "--fingerprint",
    default="",
    metavar="HEX",
    help="SHA-256 of the next hop's certificate (ams-tls); else an authority of STATION signed it.",
)
@click.option(
    "--any-name", is_flag=True, help="Its certificate need not name the host of --via (ams-tls)."
)
@plant_option
@json_option("Print one object: the route and warnings.")
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
    fingerprint: str,
    any_name: bool,
    plant: str | None,
    output: Renderer,
) -> None:
    """Add a route to NAME with NETID, through VIA, to the router of STATION.

    NETID is optional when NAME is a station of the plant.  The route is kept until it is removed.
    Routes of the plant file take precedence.  'eapctl routes test STATION NAME' tests the route.
    """
    from eap.cli.routes_view import path_of
    from eap.control.routes import ROUTES_ADD
    from eap.ops.client import connect_station

    # Appliances of the release before refuse parameters that they do not know.
    secure: dict[str, Any] = {}
    if fingerprint or any_name:
        secure = {"fingerprint": fingerprint, "check_name": not any_name}
    with connect_station(station, plant) as client:
        added = client.call(
            ROUTES_ADD, station=station, name=name, net_id=net_id, via=via, port=port,
            octets=int(octets), virtual=virtual, unidirectional=unidirectional,
            timeout_ms=timeout_ms or 0, probed=not no_probe, **secure,
        )  # fmt: skip
    route = added.route
    output.show(added, lambda _: f"{station}: added {name} ({route.net_id}, {path_of(route)})")
    for warning in added.warnings:
        output.remark(f"{station}: {warning}")


@click.command(short_help="Remove a route that was added.")
@click.argument("station", shell_complete=complete_station)
@click.argument("route")
@click.option(
    "--transport",
    default="",
    help="Transport, to choose among routes of the same name or NetID.",
)
@click.option(
    "--address", default="", help="Address, to choose among routes of the same name or NetID."
)
@plant_option
@json_option("Print one object: the route.")
def remove(
    station: str, route: str, transport: str, address: str, plant: str | None, output: Renderer
) -> None:
    """Remove ROUTE, a name or NetID, from the router of STATION.

    Routes of the plant file are removed there; auto-discovered routes expire.
    """
    from eap.control.routes import ROUTES_REMOVE
    from eap.ops.client import connect_station

    with connect_station(station, plant) as client:
        removed = client.call(
            ROUTES_REMOVE, station=station, route=route, transport=transport, address=address
        )
    row = removed.route
    output.show(removed, lambda _: f"{station}: removed {row.name} ({row.net_id}, {row.address})")


@click.command(short_help="Test routes and measure round trips.")
@click.argument("station", required=False, metavar="[STATION]", shell_complete=complete_station)
@click.argument("targets", nargs=-1, metavar="[TARGET]...")
@ms_option("timeout", "Timeout of each answer.", default=5_000, least=1)
@plant_option
@json_option("Print one object per target and line.")
@click.pass_context
def test(
    ctx: click.Context,
    station: str | None,
    targets: tuple[str, ...],
    timeout_ms: int,
    plant: str | None,
    output: Renderer,
) -> None:
    """Read the state of each TARGET through the router of STATION and measure the round trip.

    TARGET is the name of a route, a NetID, or a name of the plant (STATION, STATION/PORT,
    STATION/PORT/SLAVE).  Without TARGET all routes of STATION are tested, without STATION those of
    all running stations.  For a target that does not answer the failed hop, the cause and a remedy
    are shown.

    Exits with 1 when a target does not answer; without TARGET, routes to clients may fail.
    """
    from eap.cli.routes_view import result_table
    from eap.ops.routing import TestedTarget, list_routes

    chosen = [(station, target) for target in targets if station]
    clients: set[tuple[str, str]] = set()
    if not chosen:
        for row in (row for each in list_routes(plant, station) for row in each.stations):
            # A default route has no NetID of its own to test.
            targeted = [route for route in row.routes if route.octets]
            chosen += [(row.station, name) for name in dict.fromkeys(r.net_id for r in targeted)]
            # A client without a router, such as pyads, answers no requests; that is no failure.
            clients |= {(row.station, r.net_id) for r in row.routes if r.state == "client"}
    results = [
        TestedTarget.of(name, _test(name, target, timeout_ms, plant)) for name, target in chosen
    ]
    output.show_rows(results, result_table)
    if any(
        not result.ok and place not in clients
        for place, result in zip(chosen, results, strict=True)
    ):
        ctx.exit(ExitCode.FAILED)


def _test(station: str, target: str, timeout_ms: int, plant: str | None) -> TestResult:
    from eap.control.routes import ROUTES_TEST
    from eap.ops.client import connect_station

    within_s = timeout_ms / 1000 + ANSWER_MARGIN_S
    with connect_station(station, plant) as client:
        return client.call(
            ROUTES_TEST, within_s=within_s, station=station, target=target, timeout_ms=timeout_ms
        )


@click.command("import", short_help="Add the routes of a StaticRoutes file.")
@click.argument("station", shell_complete=complete_station)
@click.argument("file", type=_FILE)
@click.option("--dry-run", is_flag=True, help="Show the routes, but add none.")
@plant_option
@json_option("Print one object per route and line.")
@click.pass_context
def import_routes(
    ctx: click.Context,
    station: str,
    file: Path,
    dry_run: bool,
    plant: str | None,
    output: Renderer,
) -> None:
    """Add the routes of FILE (StaticRoutes.xml of TwinCAT) to the router of STATION.

    Reads name, address and NetID of each route; its type must be TCP_IP.  An existing route is
    replaced.  Flags and Timeout are kept for an export, without effect.  Brokers (Mqtt) belong to
    the plant file: the reason has their entry.  FILE - is stdin.

    Exits with 1 when a route cannot be added; the other routes are added.
    """
    from eap.cli.routes_view import import_table
    from eap.control.routes import ROUTES_IMPORT
    from eap.ops.client import connect_station

    xml = _read(file)
    with connect_station(station, plant) as client:
        rows: list[ImportRow] = client.call(
            ROUTES_IMPORT, within_s=_IMPORT_S, station=station, xml=xml, dry_run=dry_run
        )
    output.show_rows(rows, lambda each: import_table(each, is_done=not dry_run))
    if any(row.reason for row in rows):
        ctx.exit(ExitCode.FAILED)


@click.command(short_help="Write the routes of a station as a StaticRoutes file.")
@click.argument("station", shell_complete=complete_station)
@click.argument("file", type=_FILE, required=False, metavar="[FILE]")
@plant_option
def export(station: str, file: Path | None, plant: str | None) -> None:
    """Write routes and brokers of STATION to FILE or stdout, in TwinCAT's StaticRoutes format.

    The format has AMS/TCP routes and MQTT brokers, here without keys and passwords; other routes
    are named on stderr.
    """
    from eap.control.routes import ROUTES_EXPORT
    from eap.ops.client import connect_station
    from eap.runtime.durable import whole_file

    with connect_station(station, plant) as client:
        found = client.call(ROUTES_EXPORT, station=station)
    if file is None or str(file) == "-":
        write_text(found.xml, end="")
    else:
        with whole_file(file) as target:
            target.write(found.xml.encode())
        write_text(f"{file}: AMS/TCP routes of {station} written")
    if found.left_out:
        names = ", ".join(found.left_out)
        click.echo(f"{station}: routes without AMS/TCP are not exported: {names}", err=True)


def _read(file: Path) -> str:
    from eap.ops.routing import text_of_xml

    octets = sys.stdin.buffer.read() if str(file) == "-" else file.read_bytes()
    try:
        return text_of_xml(octets)
    except ValueError as exc:
        raise click.ClickException(f"{file}: {exc}") from None


@click.command(
    "add-remote",
    short_help="Add a route to a station at another router.",
    epilog=examples(
        "eapctl routes add-remote island-01 192.168.1.5 --user Administrator",
        "eapctl routes add-remote island-01 192.168.1.5 --user Administrator --password-file pw",
        "eapctl routes add-remote island-01 192.168.1.5 --user Administrator --fingerprint 5f:a4:…",
    ),
)
@click.argument("station", shell_complete=complete_station)
@click.argument("address")
@click.option(
    "--name", default="", metavar="NAME", help="Name of the route there; STATION without."
)
@click.option("--user", default="", metavar="USER", help="User of the other system.")
@click.option(
    "--password-file",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    metavar="FILE",
    help="File with the password in its first line [default: prompt]",
)
@ms_option("wait", "Timeout of the answer.", default=5_000)
@click.option("--tls", is_flag=True, help="By Secure ADS (TCP 8016), with STATION's certificate.")
@click.option(
    "--fingerprint",
    default="",
    metavar="HEX",
    help="SHA-256 of the other router's certificate (--tls); else an authority of STATION signed"
    " it.",
)
@plant_option
@json_option("Print one object: ok, result, text.")
@click.pass_context
def add_remote(
    ctx: click.Context,
    station: str,
    address: str,
    name: str,
    user: str,
    password_file: Path | None,
    wait_ms: int,
    tls: bool,
    fingerprint: str,
    plant: str | None,
    output: Renderer,
) -> None:
    """Request the router at ADDRESS, such as that of a PLC, to add a route to STATION.

    Most routers answer only hosts that they have a route to.  The request goes to UDP 48899, with
    user and password in clear.  With --tls it is encrypted, and the other router trusts the
    certificate of STATION from then on.

    Exits with 1 when the other router refuses, or does not answer.
    """
    password = _password(user, password_file)
    from eap.control.routes import ROUTES_ADD_REMOTE
    from eap.ops.client import connect_station

    # As above: only where it is used.
    secure: dict[str, Any] = {}
    if tls or fingerprint:
        secure = {"tls": True, "fingerprint": fingerprint}
    with connect_station(station, plant) as client:
        answer = client.call(
            ROUTES_ADD_REMOTE,
            within_s=wait_ms / 1000 + ANSWER_MARGIN_S,
            station=station,
            address=address,
            name=name,
            user=user,
            password=password,
            wait_ms=wait_ms,
            **secure,
        )
    output.show(answer, lambda each: f"{address}: {each.text}")
    if not answer.ok:
        ctx.exit(ExitCode.FAILED)


def _password(user: str, file: Path | None) -> str:
    if file is not None:
        from eap.net.host import read_password_text

        return read_password_text(file)
    # No option for the password itself: every user of the host can read command lines in /proc.
    return click.prompt("Password", hide_input=True, err=True) if user else ""


@click.command(
    short_help="Discover the routers of other hosts, and add temporary routes.",
    epilog=examples("eapctl routes scan", "eapctl routes scan island-01 --address 192.168.1.5"),
)
@click.argument("station", required=False, metavar="[STATION]", shell_complete=complete_station)
@click.option(
    "--address",
    default="",
    metavar="ADDRESS",
    help="IPv4 address of a host or network [default: the networks of STATION]",
)
@ms_option("wait", "Waiting time for answers.", default=1_000)
@plant_option
@json_option("Print one object per router and line.")
def scan(
    station: str | None, address: str, wait_ms: int, plant: str | None, output: Renderer
) -> None:
    """Discover the AMS routers of other hosts by UDP 48899.

    STATION, or each running station, sends the request.  A route to each router that answers is
    added for ten minutes, unless one exists or the plant file has 'learn: false'.
    """
    from contextlib import ExitStack

    from eap.cli.routes_view import neighbour_table
    from eap.control.routes import ROUTES_SCAN
    from eap.ops.client import connect

    found: list[NeighbourRow] = []
    with ExitStack() as stack:
        for client in [stack.enter_context(each) for each in connect(plant, station)]:
            rows = client.call(
                ROUTES_SCAN,
                within_s=wait_ms / 1000 + ANSWER_MARGIN_S,
                station=station or "",
                address=address,
                wait_ms=wait_ms,
            )
            found += rows
    output.show_rows(found, neighbour_table)
