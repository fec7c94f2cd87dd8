"""Bus of a command of ``eapctl bus``: a port of a running station, or an interface."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import click

from eap.cli.params import CommandT
from eap.ids import InterfaceUri

if TYPE_CHECKING:
    from eap.ops.bus_slave import SlaveBus

_PLACE, _INTERFACE, _PLANT = "place", "interface", "plant"
_FORMS = "STATION/PORT", "--interface URI"


class StationBus(NamedTuple):
    """A bus port of a running station, of a certain plant if several run that station."""

    station: str
    port: str
    plant: str | None = None

    def __str__(self) -> str:
        return f"{self.station}/{self.port}"


class GatewayPlace(NamedTuple):
    """A mailbox gateway (``eapctl gw``)."""

    host: str
    port: int
    tcp: bool = False
    mailbox: int | None = None
    """Octets of the slave's mailboxes, in place of the master's description."""


Place: TypeAlias = StationBus | InterfaceUri | GatewayPlace


class BusCommand(click.Command):
    """A command whose first argument is STATION/PORT, unless ``--interface`` says where the bus is.

    Its function gets the parameter *bus*, a Place.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the command line; raise UsageError that shows both forms if neither is there."""
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
        """Return what is on the command line: no STATION/PORT behind ``--interface``."""
        params = super().get_params(ctx)
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
                    text = f"{word!r} and --interface are two buses: leave one out"
                    raise click.UsageError(text, ctx)
                return


def bus_options(command: CommandT) -> CommandT:
    """Add STATION/PORT as the first argument, ``--interface`` and ``--plant``."""
    interface = click.option(
        "--interface",
        type=parse_uri,
        metavar="URI",
        help="Where the bus is, in place of STATION/PORT: ethernet://IFACE (needs CAP_NET_RAW) or"
        " udp://ADDRESS[:PORT].",
    )
    plant = click.option("--plant", metavar="NAME", help="Only the appliance that runs this plant.")
    place = click.argument(_PLACE, required=False, callback=_to_port, metavar="STATION/PORT")
    return place(interface(plant(command)))


def place_parameters() -> frozenset[str]:
    """Return the names of the parameters that say which bus."""
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


def open_session(bus: Place) -> AbstractContextManager[SlaveBus]:
    """Open the bus; imported here, so that ``--help`` need not wait for a master."""
    if isinstance(bus, StationBus):
        from eap.ops.bus_running import open_running

        return open_running(*bus)
    if isinstance(bus, GatewayPlace):
        from eap.ops.bus_gateway import open_gateway

        return open_gateway(bus.host, bus.port, tcp=bus.tcp, mailbox=bus.mailbox)
    from eap.ops import bus_session

    return bus_session.open_bus(bus)


def _to_port(ctx: click.Context, param: click.Parameter, text: str | None) -> StationBus | None:
    del param
    port = parse_port(text or "")
    if port is None and not ctx.resilient_parsing:
        problem = f"{text!r} is no STATION/PORT: " if text else ""
        command = ctx.command
        forms = " or ".join(
            f"{ctx.command_path} {command.usage_of(ctx, form)}"
            for form in _FORMS
            if isinstance(command, BusCommand)
        )
        raise click.UsageError(f"{problem}say which bus: {forms}", ctx)
    return port
