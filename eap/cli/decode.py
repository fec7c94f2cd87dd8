"""``eapctl decode``: what is in these octets, or in this capture."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from eap.cli.group import ExitCode
from eap.cli.output import write_json, write_tables
from eap.cli.params import json_option

if TYPE_CHECKING:
    from collections.abc import Iterator

    from eap.appliance.commands.packets import Packet

_SEPARATORS = str.maketrans("", "", ":-, \t\r\n")


class _Frame(NamedTuple):
    """One frame to show, and how it came."""

    data: bytes
    packet: Packet | None = None
    number: int = 0
    at_ns: int | None = None

    def origin(self) -> dict[str, Any]:
        """Return what a capture knows beside the frame: number, time in seconds, addresses."""
        if self.packet is None:
            return {}
        source, destination = self.packet.source, self.packet.destination
        known: dict[str, Any] = {
            "transport": self.packet.transport,
            "source": source,
            "destination": destination,
        }
        if self.packet.vlan_id is not None:
            known["vlan_id"] = self.packet.vlan_id
        if self.at_ns is None:
            return known
        return {"packet": self.number, "time": self.at_ns / 1e9} | known


@click.command(short_help="Say what is in a frame or in a capture.")
@click.argument("source", metavar="HEX|FILE", nargs=-1, required=True)
@json_option("Print one object a frame, on one line.")
@click.pass_context
def decode(ctx: click.Context, source: tuple[str, ...], as_json: bool) -> None:
    """Decode one frame given as HEX, or all frames of a pcap or pcapng FILE.

    HEX starts at the EtherCAT header or at the Ethernet header; spaces are allowed.  A file whose
    name is hexadecimal digits is written ./NAME.  In a file, frames are found under EtherType
    0x88A4 and on UDP and TCP port 34980.

    Exit code 1 means that a frame had an error, 2 that the input cannot be read.
    """
    from eap.appliance.commands.decode import decode_frame

    failed, shown = False, 0
    for frame in _frames(" ".join(source)):
        fields = decode_frame(frame.data)
        failed |= fields["error"] is not None
        shown += 1
        if as_json:
            write_json(fields | frame.origin())
        else:
            from eap.cli.decode_view import frame_tree

            write_tables([frame_tree(fields, frame.origin())])
    if not shown:
        click.echo("no EtherCAT frame in this capture", err=True)
    if failed:
        ctx.exit(ExitCode.FAILED)


def _frames(source: str) -> Iterator[_Frame]:
    try:
        octets = bytes.fromhex(source.translate(_SEPARATORS).removeprefix("0x"))
    except ValueError:
        yield from _frames_of_file(source)
        return
    if not octets:
        raise click.UsageError("there are no octets to decode")
    yield from _frames_of_octets(octets)


def _frames_of_file(name: str) -> Iterator[_Frame]:
    from eap.appliance.commands.capture import iter_capture
    from eap.errors import CodecError

    try:
        for captured in iter_capture(Path(name)):
            yield _Frame(captured.data, captured.packet, captured.number, captured.at_ns)
    except (OSError, CodecError) as exc:
        if isinstance(exc, OSError) and exc.errno in {errno.ENOENT, errno.ENAMETOOLONG}:
            raise click.UsageError(f"{name!r} is neither a file nor hexadecimal digits") from None
        raise click.UsageError(str(exc)) from None


def _frames_of_octets(octets: bytes) -> Iterator[_Frame]:
    from eap.appliance.commands.packets import cut_frames, unwrap

    packet = unwrap(octets)
    if packet is None:
        yield _Frame(octets)
    elif packet.segment is None:
        yield _Frame(packet.payload, packet)
    else:
        stream = bytearray(packet.payload)
        for data in cut_frames(stream):
            yield _Frame(data, packet)
        if stream:
            yield _Frame(bytes(stream), packet)
