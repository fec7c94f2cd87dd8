"""Options, arguments and parameter types that several commands share, and the bus of a command."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import click

from eap.cli.completion import complete_bus, complete_plant, complete_station
from eap.cli.output import CommandT
from eap.errors import ConfigError
from eap.ids import InterfaceUri, ObjectId

if TYPE_CHECKING:
    from eap.codec.datatypes import DataType
    from eap.ops.bus_session import SlaveBus


MIN_CYCLE_US = 100
MAX_CYCLE_US = 60_000_000

ANSWER_MARGIN_S = 5.0
"""Time that a command waits for its appliance beyond the time that the appliance itself waits."""

PLANT_FILE = click.Path(path_type=Path)
"""Path of a plant file; the loader reports why it cannot be read."""


def plant_option(command: CommandT) -> CommandT:
    """Add ``--plant``, which chooses among running appliances."""
    return click.option(
        "--plant",
        metavar="NAME",
        help="Only the appliance that runs this plant.",
        shell_complete=complete_plant,
    )(command)


def station_option(command: CommandT) -> CommandT:
    """Add ``--station``, which chooses among running stations."""
    return click.option(
        "--station", metavar="NAME", help="Only this station.", shell_complete=complete_station
    )(command)


def ms_option(
    name: str, text: str, *, default: int, least: int = 10
) -> Callable[[CommandT], CommandT]:
    """Return the decorator that adds the option *name* of at most a minute in milliseconds.

    The function gets its value as *name* with ``_ms`` behind it; *text* is its help.
    """
    return click.option(
        f"--{name}",
        f"{name}_ms",
        type=click.IntRange(least, 60_000),
        default=default,
        show_default=True,
        metavar="MS",
        help=text,
    )


def parse_cycle(ctx: click.Context, param: click.Parameter, text: str | None) -> int | None:
    """Return the microseconds of a device cycle given in milliseconds, as an option's callback.

    Raises:
        click.BadParameter: a device cannot have such a cycle.
    """
    del ctx, param
    if text is None:
        return None
    try:
        cycle_us = float(text) * 1000
    except ValueError:
        cycle_us = 0.0
    # Whole microseconds: the dictionary and the plant file have no fractions.
    if not MIN_CYCLE_US <= cycle_us <= MAX_CYCLE_US or cycle_us % 1:
        raise click.BadParameter(
            f"{text!r} is not a device cycle: expected 0.1 to 60000 milliseconds"
        )
    return int(cycle_us)


def check_new_file(target: Path, *, force: bool) -> None:
    """Check that *target* can be made, before the work whose result goes there.

    Raises:
        ConfigError: it exists and is not to be overwritten, or has no folder.
    """
    if str(target) == "-":
        raise ConfigError("the result is a file: name one instead of -")
    if target.exists() and not force:
        raise ConfigError(f"{target} exists: overwrite it with --force")
    if not target.parent.is_dir():
        raise ConfigError(f"{target} cannot be written: no folder {target.parent}")


def examples(*lines: str) -> str:
    """Return the epilog of a command: examples of calls."""
    return "\n  ".join(("\b\nExamples:", *lines))


def number_up_to(limit: int) -> Callable[[str | int], int]:
    """Return the parser of a whole number, hexadecimal or decimal; it raises BadParameter."""

    def parse(text: str | int) -> int:
        try:
            number = text if isinstance(text, int) else int(text, 0)
        except ValueError:
            number = -1
        if not 0 <= number <= limit:
            raise click.BadParameter(f"{text!r} is not a number from 0 to 0x{limit:X}")
        return number

    return parse


def parse_entry(text: str) -> ObjectId:
    """Read ``INDEX[:SUB]`` in hexadecimal; raise BadParameter with an example otherwise."""
    try:
        return ObjectId.parse(text)
    except ValueError as exc:
        raise click.BadParameter(str(exc)) from None


def parse_type(text: str) -> DataType:
    """Read a data type; raise BadParameter with a suggestion otherwise."""
    from eap.codec import datatypes

    try:
        return datatypes.parse(text)
    except ValueError as exc:
        raise click.BadParameter(str(exc)) from None


def parse_octets(text: str) -> bytes:
    """Read hexadecimal digits; raise BadParameter if there is anything else."""
    try:
        return bytes.fromhex(text.removeprefix("0x"))
    except ValueError:
        raise click.BadParameter(
            f"{text!r} is not hexadecimal: expected pairs of digits, such as 0aff"
        ) from None


def slave_argument(command: CommandT) -> CommandT:
    """Add the argument SLAVE."""
    return click.argument("slave", metavar="SLAVE")(command)


_PLACE, _INTERFACE, _PLANT = "place", "interface", "plant"
_FORMS = "STATION/PORT", "--interface URI"


class StationBus(NamedTuple):
    """A bus port of a running station, of a certain plant if several run that station."""

    station: str
    port: str
    plant: str | None = None

    def __str__(self) -> str:
        return f"{self.station}/{self.port}"


class GatewayTarget(NamedTuple):
    """A mailbox gateway (``eapctl gw``)."""

    host: str
    port: int
    tcp: bool = False
    mailbox: int | None = None
    """Octets of the slave's mailboxes, in place of the master's description."""


BusAddress: TypeAlias = StationBus | InterfaceUri | GatewayTarget


class BusCommand(click.Command):
    """A command whose first argument is STATION/PORT, unless ``--interface`` gives the bus.

    Its function gets the parameter *bus*, a BusAddress.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the command line; raise UsageError that shows both forms if neither is there."""
        # What follows -- is no option, even if it looks like one.
        words = args[: args.index("--")] if "--" in args else args
        by_interface = any(word.partition("=")[0] == "--interface" for word in words)
        ctx.meta[_INTERFACE] = by_interface
        if by_interface and not ctx.resilient_parsing:
            self._refuse_both(ctx, words)
        rest = super().parse_args(ctx, args)
        place = ctx.params.pop(_PLACE, None)
        interface, plant = ctx.params.pop(_INTERFACE, None), ctx.params.pop(_PLANT, None)
        if interface is not None:
            if plant is not None:
                raise click.UsageError("--plant goes with STATION/PORT, not --interface", ctx)
            ctx.params["bus"] = interface
        elif place is not None:
            ctx.params["bus"] = place._replace(plant=plant)
        return rest

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return the parameters: without STATION/PORT if ``--interface`` is given."""
        params = super().get_params(ctx)
        # click would take the first word, SLAVE, for an optional STATION/PORT that was left out.
        if ctx.meta.get(_INTERFACE):
            return [param for param in params if param.name != _PLACE]
        return params

    def format_usage(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Show both forms."""
        for form, prefix in zip(_FORMS, (None, " " * len("Usage: ")), strict=True):
            formatter.write_usage(ctx.command_path, self.usage_of(ctx, form), prefix)

    def usage_of(self, ctx: click.Context, form: str) -> str:
        """Return arguments and options in words."""
        arguments = [param for param in self.params if isinstance(param, click.Argument)]
        words = [word for each in arguments[1:] for word in each.get_usage_pieces(ctx)]
        return " ".join([form, *words, "[OPTIONS]"])

    def _refuse_both(self, ctx: click.Context, words: list[str]) -> None:
        """Raise UsageError if the first argument is STATION/PORT all the same."""
        valued = {
            name
            for param in self.params
            if isinstance(param, click.Option) and not param.is_flag
            for name in param.opts
        }
        rest = iter(words)
        for word in rest:
            if word in valued:
                next(rest, None)
            elif not word.startswith("-"):
                if parse_port(word) is not None:
                    text = f"{word!r} and --interface are two buses: omit one"
                    raise click.UsageError(text, ctx)
                return


def bus_options(command: CommandT) -> CommandT:
    """Add STATION/PORT as the first argument, ``--interface`` and ``--plant``."""
    interface = click.option(
        "--interface",
        type=parse_uri,
        metavar="URI",
        help="Interface of the bus, instead of STATION/PORT: ethernet://IFACE (needs CAP_NET_RAW)"
        " or udp://ADDRESS[:PORT].",
    )
    plant = click.option("--plant", metavar="NAME", help="Only the appliance that runs this plant.")
    place = click.argument(
        _PLACE,
        required=False,
        callback=_to_port,
        metavar="STATION/PORT",
        shell_complete=complete_bus,
    )
    return place(interface(plant(command)))


def bus_parameters() -> frozenset[str]:
    """Return the names of the parameters that choose the bus."""
    return frozenset((_PLACE, _INTERFACE, _PLANT))


def parse_port(text: str) -> StationBus | None:
    """Read STATION/PORT; return None if it is something else."""
    station, slash, port = text.partition("/")
    return StationBus(station, port) if slash and station and port and "/" not in port else None


def parse_uri(text: str) -> InterfaceUri:
    """Read where a bus is; raise BadParameter with the reason otherwise."""
    try:
        uri = InterfaceUri.parse(text)
    except ValueError as exc:
        raise click.BadParameter(str(exc)) from None
    if uri.scheme not in {"ethernet", "udp"}:
        raise click.BadParameter(
            f"a bus is reached by ethernet://IFACE or udp://ADDRESS, not by {uri}"
        )
    return uri


def open_session(bus: BusAddress) -> AbstractContextManager[SlaveBus]:
    """Open the bus; imported here, so that ``--help`` need not wait for a master."""
    if isinstance(bus, StationBus):
        from eap.ops.bus_running import open_running

        return open_running(*bus)
    if isinstance(bus, GatewayTarget):
        from eap.ops.bus_gateway import open_gateway

        return open_gateway(bus.host, bus.port, tcp=bus.tcp, mailbox=bus.mailbox)
    from eap.ops import bus_session

    return bus_session.open_bus(bus)


def _to_port(ctx: click.Context, param: click.Parameter, text: str | None) -> StationBus | None:
    del param
    port = parse_port(text or "")
    if port is None and not ctx.resilient_parsing:
        problem = f"{text!r} is not STATION/PORT" if text else "no bus given"
        command = ctx.command
        forms = " or ".join(
            f"{ctx.command_path} {command.usage_of(ctx, form)}"
            for form in _FORMS
            if isinstance(command, BusCommand)
        )
        raise click.UsageError(f"{problem}: expected {forms}", ctx)
    return port
