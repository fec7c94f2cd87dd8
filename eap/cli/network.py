"""``eapctl scan`` and ``trace``: stations of the plant, and the hops on the path to a device."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import click

from eap.cli.completion import complete_target
from eap.cli.group import ExitCode
from eap.cli.output import Column, Renderer, Styled, TextTable, json_option
from eap.cli.params import examples, plant_option
from eap.quantities import count, duration

if TYPE_CHECKING:
    from eap.control.routes import (
        HopRow,
        PlantScan,
        ScanVia,
        StationEntry,
        TargetAnswer,
        TracedPath,
    )

_VIA = click.option(
    "--via", metavar="STATION", help="Station whose router sends the requests [default: the first]"
)


@click.command(
    epilog=examples("eapctl scan", "eapctl scan --via island-02 --json"),
)
@_VIA
@plant_option
@json_option("Print one object: stations, with their ports and slaves.")
def scan(via: str | None, plant: str | None, output: Renderer) -> None:
    """List the stations of the plant, local and remote, with their ports and slaves.

    The names are those that 'eapctl od', 'state' and 'trace' accept; each line ends with the Python
    code that connects pyads to the device.  A station or bus that does not answer is shown as in
    the plant file, with the reason on stderr.
    """
    from eap.control.routes import MergedScan
    from eap.ops import routing

    answers = routing.scan(plant, via)
    stations = [station for answer in answers for station in answer.stations]
    merged = MergedScan(stations, [answer.via for answer in answers])
    output.show(merged, lambda _: map(scan_table, answers))
    # Behind the table and on stderr, so that a pipe has the table alone.
    for line in fault_lines(stations):
        click.echo(line, err=True)


@click.command(
    epilog=examples(
        "eapctl trace island-03/bus0/1001",
        "eapctl trace 5.1.2.3.1.1:851 --via island-02",
    ),
)
@click.argument(
    "targets", nargs=-1, required=True, metavar="TARGET…", shell_complete=complete_target
)
@_VIA
@plant_option
@json_option("Print one object per target; docs/trace.md explains its fields.")
@click.pass_context
def trace(
    ctx: click.Context,
    targets: tuple[str, ...],
    via: str | None,
    plant: str | None,
    output: Renderer,
) -> None:
    """Query each router on the path to TARGET for its next hop, then TARGET itself.

    TARGET is STATION, STATION/PORT or STATION/PORT/SLAVE of the plant, or NETID:PORT.

    Exits with 1 when TARGET is not reached; the last line names the hop that failed and the cause.
    """
    from eap.ops import routing

    is_ok = True
    for target in targets:
        found = routing.trace(target, plant, via)
        is_ok = is_ok and found.ok
        output.show(found, trace_view)
    if not is_ok:
        ctx.exit(ExitCode.FAILED)


class _Line(NamedTuple):
    name: str
    kind: str
    state: str
    address: str
    client: str


def scan_table(answer: PlantScan) -> TextTable:
    """Return the table of one plant: names for other commands, AMS addresses, lines of pyads.

    A narrow terminal omits the lines of pyads: a wrapped line could not be pasted.
    """
    table = TextTable(
        "Name", Column("Kind", rank=1), "State", "AMS address", Column("pyads", rank=2)
    )
    for station in answer.stations:
        for line in _lines(station, answer.via):
            table.add_row(*line)
    return table


def fault_lines(stations: list[StationEntry]) -> Iterator[str]:
    """Yield the stations and ports that are not complete, and why."""
    for station in stations:
        if station.error:
            yield f"{station.name}: {station.error}"
        for port in station.ports:
            if port.error:
                yield f"{station.name}/{port.name}: {port.error}"


def client_line(net_id: str, port: int, address: str) -> str:
    """Return the Python line that connects pyads to a device; empty without AMS/TCP."""
    if not address:
        return ""
    return f'pyads.Connection("{net_id}", {port}, "{address}")'


def _lines(station: StationEntry, via: ScanVia) -> Iterator[_Line]:
    from eap.codec.ams import DEVICE_PORT, SYSTEM_PORT

    def client(net_id: str, port: int) -> tuple[str, str]:
        return f"{net_id}:{port}", client_line(net_id, port, via.address)

    name = station.name
    state = "?" if station.error else ""
    yield _Line(name, "router", state, *client(station.net_id, SYSTEM_PORT))
    for port in station.ports:
        place = f"{name}/{port.name}"
        what = f"  {port.kind} {port.interface}".rstrip()
        state = "?" if port.error else ""
        yield _Line(place, what, state, *client(port.net_id, DEVICE_PORT))
        for slave in port.slaves:
            yield _Line(
                f"{place}/{slave.address}",
                f"    {slave.name}",
                slave.state or "?",
                *client(port.net_id, slave.address),
            )


def trace_view(found: TracedPath) -> Iterator[TextTable | Styled | str]:
    """Yield the path, the answer of the target, and faults on the path."""
    name = f" ({found.name})" if found.name not in {"", found.target} else ""
    yield f"{found.target}{name} is {found.address}"
    table = TextTable(
        Column("Hop", is_number=True),
        "Router",
        Column("NetID", rank=2),
        Column("Total", is_number=True),
        Column("Hop time", rank=1, is_number=True),
        Column("Next hop", wraps=True),
    )
    for number, hop in enumerate(found.hops, 1):
        times = (duration(hop.took_us), duration(hop.spent_us))
        table.add_row(str(number), hop.station, hop.net_id, *times, _next_hop(hop))
    if found.answer is not None:
        answer = found.answer
        table.add_row("", "target", "", duration(answer.took_us), "", _answer_text(answer))
    yield table
    yield from _remarks(found)
    if found.why:
        yield Styled(f"not reached: {found.why}", style="bold red")


def _remarks(found: TracedPath) -> Iterator[Styled | str]:
    """Yield what limits requests on the path, and the faults behind it that *why* lacks."""
    for hop in found.hops:
        refused = [service for service, allowed in hop.may.items() if allowed is False]
        if refused:
            yield f"{hop.station}: its access rules refuse {', '.join(refused)}"
    for hop in found.hops:
        if hop.interrupted:
            many = count(hop.interrupted, "subscription")
            text = f"{hop.station}: {many} interrupted for {hop.interrupted_s} s"
            yield Styled(text, style="bold red")
    faults = (fault for hop in found.hops for fault in hop.faults if fault not in found.why)
    for fault in faults:
        yield Styled(fault, style="yellow")


def _next_hop(hop: HopRow) -> str:
    if hop.opaque:
        return "does not report its routes"
    if not hop.route:
        return "has no route" if hop.why else "local"
    return f"{hop.route}: {hop.transport} to {hop.address} ({hop.state})"


def _answer_text(answer: TargetAnswer) -> str:
    from eap.codec.ads import AdsState

    if answer.text:
        return f"answers: {answer.text}" if answer.error else answer.text
    # Devices of other vendors may have states that ADS does not name: shown as numbers.
    known = AdsState._value2member_map_.get(answer.ads_state)
    state = known.name if isinstance(known, AdsState) else answer.ads_state
    return f"answers: {state}, device state {answer.device_state}"
