"""What the commands of ``eapctl bus`` have in common: the bus, and how things on it are written."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import click

from eap.ids import InterfaceUri

if TYPE_CHECKING:
    from eap.appliance.bus_session import BusSession
    from eap.codec.datatypes import DataType

CommandT = TypeVar("CommandT", bound=Callable[..., Any])


Entry: TypeAlias = tuple[int, int]
"""Index and subindex."""


class BusCommand(click.Command):
    """A command on a bus; says so where a bus is given as a port of a running station."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the command line; raise UsageError for STATION/PORT."""
        asks = {*ctx.help_option_names, "--help"} & {*args}
        given = any(word.partition("=")[0] == "--interface" for word in args)
        if not given and not asks and args and "/" in args[0]:
            raise click.UsageError(
                f"{args[0]!r}: ports of running stations have no bus yet; expected"
                " --interface ethernet://IFACE or udp://ADDRESS",
                ctx,
            )
        return super().parse_args(ctx, args)


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


def number_up_to(limit: int) -> Callable[[str | int], int]:
    """Return what reads a whole number in hex or decimal, or raises BadParameter."""

    def parse(text: str | int) -> int:
        try:
            number = text if isinstance(text, int) else int(text, 0)
        except ValueError:
            number = -1
        if not 0 <= number <= limit:
            raise click.BadParameter(f"{text!r} is not a number from 0 to 0x{limit:X}")
        return number

    return parse


def parse_entry(text: str) -> Entry:
    """Read ``INDEX[:SUB]`` in hex or decimal; raise BadParameter with an example otherwise."""
    index, _, subindex = text.partition(":")
    try:
        numbers = int(index, 0), int(subindex or "0", 0)
    except ValueError:
        numbers = -1, 0
    if not 0 <= numbers[0] <= 0xFFFF or not 0 <= numbers[1] <= 0xFF:
        raise click.BadParameter(f"{text!r} is not INDEX[:SUB], such as 0x1018:1")
    return numbers


def parse_type(text: str) -> DataType:
    """Look a data type up; raise BadParameter with what comes near otherwise."""
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
        raise click.BadParameter(f"{text!r} is not pairs of hexadecimal digits") from None


def interface_option(command: CommandT) -> CommandT:
    """Add ``--interface``, which says where the bus is."""
    return click.option(
        "--interface",
        required=True,
        type=parse_uri,
        metavar="URI",
        help="Where the bus is: ethernet://IFACE (needs CAP_NET_RAW) or udp://ADDRESS[:PORT].",
    )(command)


def slave_argument(command: CommandT) -> CommandT:
    """Add the argument SLAVE."""
    return click.argument("slave", metavar="SLAVE")(command)


def open_session(interface: InterfaceUri) -> AbstractContextManager[BusSession]:
    """Open the bus; imported here, so that ``--help`` need not wait for a master."""
    from eap.appliance.bus_session import open_bus

    return open_bus(interface)
