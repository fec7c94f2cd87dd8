"""``eapctl discover``: the process data on a network, live or from a capture."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING

import click

from eap.cli.group import ExitCode
from eap.cli.output import Renderer, json_option, repaint, write_view
from eap.cli.params import PLANT_FILE, check_new_file, examples
from eap.errors import CodecError, ConfigError, ControlError, EnvironmentalError
from eap.ids import NetId
from eap.quantities import count

if TYPE_CHECKING:
    from eap.ops.discover import DiscoveredPd, ObserverFeed, Taker

_USUAL_S = 5.0
"""Length of a capture whose result goes to a file, a pipe or a plant file."""
_REDRAW_S = 1.0
_REST = 10
"""Time between two screens at least, as a multiple of the time that the first one took."""
_FROM_HELP = (
    "NetID of a publisher: ask its dictionary for names and types, through a running station. May"
    " be repeated."
)


def _parse_net_id(text: str) -> str:
    """Read a NetID; raise BadParameter otherwise."""
    try:
        return str(NetId.parse(text))
    except ValueError as exc:
        raise click.BadParameter(str(exc)) from None


@click.command(
    epilog=examples(
        "eapctl discover eth0",
        "eapctl discover eth0 --for 10 --write found.yaml",
        "eapctl discover eth0 --from 5.23.91.23.2.1",
        "eapctl discover --pcap line.pcapng --plant plant.yaml --json",
    ),
)
@click.argument("interface", required=False)
@click.option(
    "--pcap",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Read a pcap or pcapng file instead of an interface.",
)
@click.option(
    "--from", "net_ids", type=_parse_net_id, multiple=True, metavar="NETID", help=_FROM_HELP
)
@click.option(
    "--for",
    "for_s",
    type=click.FloatRange(0.1, 86_400),
    metavar="S",
    help="Seconds to watch [default: on a terminal until Ctrl-C, else 5]",
)
@click.option(
    "--plant",
    "plants",
    type=PLANT_FILE,
    multiple=True,
    metavar="FILE",
    help="Compare with the subscriptions of a plant file, besides those of running stations.",
)
@click.option(
    "--write",
    "target",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="PLANT",
    help="Write a plant file with a subscription for each PD.",
)
@click.option("--force", is_flag=True, help="Overwrite an existing file.")
@json_option("Print one object per PD.")
@click.pass_context
def discover(
    ctx: click.Context,
    interface: str | None,
    pcap: Path | None,
    net_ids: tuple[str, ...],
    for_s: float | None,
    plants: tuple[Path, ...],
    target: Path | None,
    force: bool,
    output: Renderer,
) -> None:
    """Find all process data on a network: who publishes which PD, how often, and who takes it.

    INTERFACE is a network interface, such as eth0; lo shows the stations of this host.  Watching
    needs CAP_NET_RAW, changes nothing, and works beside running stations.

    Exits with 1 when nothing was found, with 2 when the interface or file cannot be read.
    """
    from eap.ops.discover import ObserverFeed, discovered

    _check_usage(interface, pcap, net_ids, for_s)
    if target is not None:
        check_new_file(target, force=force)
    takers = _takers(plants)
    discovery = ObserverFeed()
    fault = None
    if pcap is not None:
        fault = _read(discovery, pcap)
    elif interface is not None:
        is_live = sys.stdout.isatty() and not output.is_json and not _is_plain()
        if for_s is None and (not is_live or target is not None):
            for_s = _USUAL_S
        _watch(discovery, interface, for_s, takers if is_live else None)
    rows = _completed(discovered(discovery, takers), net_ids, takers)
    _show(rows, discovery, output)
    if target is not None and rows:
        _write(target, rows, pcap or interface)
    if fault is not None:
        raise ConfigError(fault)
    if not rows:
        ctx.exit(ExitCode.FAILED)


def _is_plain() -> bool:
    """Return whether the terminal cannot draw over what it shows."""
    return os.environ.get("TERM", "dumb").lower() in {"", "dumb", "unknown"}


def _check_usage(
    interface: str | None, pcap: Path | None, net_ids: tuple[str, ...], for_s: float | None
) -> None:
    if interface is not None and pcap is not None:
        raise click.UsageError("INTERFACE and --pcap are two sources: omit one")
    if interface is None and for_s is not None:
        raise click.UsageError("--for goes with INTERFACE")
    if interface is None and pcap is None and not net_ids:
        raise click.UsageError("nothing to look at: give INTERFACE, --pcap FILE or --from NETID")


def _takers(plants: tuple[Path, ...]) -> list[Taker]:
    """Return the subscriptions of running stations and of plant files."""
    from eap.ops.discover import running_stations, takers_of

    stations, errors = running_stations()
    for error in errors:
        click.echo(str(error), err=True)
    for path in plants:
        from eap.ops.plant import load_or_raise  # yaml

        stations += load_or_raise(path).stations
    return takers_of(stations)


def _read(discovery: ObserverFeed, path: Path) -> str | None:
    """Read a capture; return its fault, where what came before it counts all the same."""
    # A pipe cannot be read twice, for losses and for frames, and a device might never end.
    if path.exists() and not path.is_file():
        kind = "a folder" if path.is_dir() else "no regular file"
        raise EnvironmentalError(f"{path} cannot be read: it is {kind}")
    try:
        discovery.read(path)
    except OSError as exc:
        fault = f"{path} cannot be read: {exc.strerror}"
    except CodecError as exc:
        fault = str(exc)
    else:
        return None
    if not discovery.observer.frames:
        raise ConfigError(fault)
    return fault


def _watch(
    discovery: ObserverFeed, interface: str, for_s: float | None, takers: list[Taker] | None
) -> None:
    """Watch an interface until the time is over or a signal comes; redraw with *takers*."""
    from eap.cli.discover_view import live_view
    from eap.ops.discover import discovered

    # A screen of thousands of PDs takes long: then there are fewer of them, so that the capture is
    # read in time.
    draw_at = 0.0
    with _ended_by_signal():
        try:
            for _ in discovery.watch(interface, for_s):
                if takers is None:
                    continue
                start = monotonic()
                if start >= draw_at:
                    rows = discovered(discovery, takers, with_guess=False)
                    repaint(live_view(rows, discovery, interface))
                    draw_at = monotonic() + max(_REDRAW_S, _REST * (monotonic() - start))
        except KeyboardInterrupt:
            pass
    if takers is not None:
        repaint(())


@contextmanager
def _ended_by_signal() -> Iterator[None]:
    """End the block as Ctrl-C does when SIGTERM comes: the result is printed then."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _completed(
    rows: list[DiscoveredPd], net_ids: tuple[str, ...], takers: list[Taker]
) -> list[DiscoveredPd]:
    """Return the rows with names and types of the dictionaries of publishers."""
    if not net_ids:
        return rows
    from eap.ops.discover import complete
    from eap.ops.publisher_dictionary import PublishedPd, ask_publisher

    published: list[PublishedPd] = []
    for net_id in net_ids:
        try:
            published += ask_publisher(net_id)
        except ControlError as exc:
            if not rows and len(net_ids) == 1:
                raise
            click.echo(str(exc), err=True)
    completed, remarks = complete(rows, published, takers)
    for remark in remarks:
        click.echo(remark, err=True)
    return completed


def _show(rows: list[DiscoveredPd], discovery: ObserverFeed, output: Renderer) -> None:
    from eap.cli.discover_view import discovery_view, notes

    if output.is_json:
        output.show_rows(rows, lambda _: "")
        for line in discovery.losses.lines():
            click.echo(line, err=True)
        return
    if rows:
        write_view(discovery_view(rows))
    for line in notes(rows, discovery):
        click.echo(line, err=True)


def _write(target: Path, rows: list[DiscoveredPd], source: Path | str | None) -> None:
    from eap.ops.discovered_plant import discovered_plant
    from eap.pd.rules import plant_name_of
    from eap.runtime.durable import whole_file

    interface = source if isinstance(source, str) else ""
    text, taken = discovered_plant(plant_name_of(target.stem), rows, interface)
    with whole_file(target) as file:
        file.write(text.encode())
    click.echo(f"{target}: {count(taken, 'subscription')} written", err=True)
