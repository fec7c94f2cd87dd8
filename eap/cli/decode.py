"""``eapctl decode``: the frames in hexadecimal digits or in a capture."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eap.cli.group import ExitCode
from eap.cli.output import Renderer, json_option

if TYPE_CHECKING:
    from rich.tree import Tree

    from eap.ops.decode import DecodedAms, DecodedDatagram, DecodedFrame
    from eap.recording.packets import Packet

_NAMES = {
    1: "datagrams",
    2: "AMS",
    3: "raw I/O",
    4: "process data",
    5: "mailbox",
}
_SHOWN_OCTETS = 32
_SEPARATORS = str.maketrans("", "", ":-, \t\r\n")


@click.command()
@click.argument("source", metavar="HEX|FILE", nargs=-1, required=True)
@json_option("Print one object per frame and line.")
@click.pass_context
def decode(ctx: click.Context, source: tuple[str, ...], output: Renderer) -> None:
    """Decode one frame given as HEX, or all frames of a pcap or pcapng FILE.

    HEX starts at the EtherCAT header or at the Ethernet header; spaces are allowed.  Write ./NAME
    for a file whose name consists of hexadecimal digits.  In a file, frames are decoded under
    EtherType 0x88A4 and on UDP and TCP port 34980.

    Exits with 1 when a frame has an error, with 2 when the input cannot be read.
    """
    failed, shown = False, 0
    for frame in _frames(" ".join(source)):
        failed |= frame.error is not None
        shown += 1
        output.show(frame, frame_view)
    if not shown:
        click.echo("the capture has no EtherCAT frame", err=True)
    if failed:
        ctx.exit(ExitCode.FAILED)


def _frames(source: str) -> Iterator[DecodedFrame]:
    try:
        # Digits first: a file whose name is all digits needs ./ in front, as the help says.
        octets = bytes.fromhex(source.translate(_SEPARATORS).removeprefix("0x"))
    except ValueError:
        yield from _frames_of_file(source)
        return
    if not octets:
        raise click.UsageError("no bytes to decode: give HEX or FILE")
    yield from _frames_of_octets(octets)


def _frames_of_file(name: str) -> Iterator[DecodedFrame]:
    from eap.errors import CodecError
    from eap.ops.decode import CycleOrders, decode_frame
    from eap.recording.packets import iter_capture

    orders = CycleOrders()
    try:
        for captured in iter_capture(Path(name)):
            frame = decode_frame(captured.data)
            frame.packet, frame.time = captured.number, captured.at_ns / 1e9
            orders.enter(frame)
            yield _with_origin(frame, captured.packet)
    except (OSError, CodecError) as exc:
        if isinstance(exc, OSError) and exc.errno in {errno.ENOENT, errno.ENAMETOOLONG}:
            raise click.UsageError(f"{name!r} is neither a file nor hexadecimal digits") from None
        raise click.UsageError(str(exc)) from None


def _frames_of_octets(octets: bytes) -> Iterator[DecodedFrame]:
    from eap.ops.decode import decode_frame
    from eap.recording.packets import cut_frames, unwrap

    packet = unwrap(octets)
    if packet is None:
        yield decode_frame(octets)
    elif packet.segment is None:
        yield _with_origin(decode_frame(packet.payload), packet)
    else:
        # Several frames may be in one TCP segment, and its last one may end in the next.
        stream = bytearray(packet.payload)
        frames = list(cut_frames(stream))
        for data in [*frames, bytes(stream)] if stream else frames:
            yield _with_origin(decode_frame(data), packet)


def _with_origin(frame: DecodedFrame, packet: Packet) -> DecodedFrame:
    frame.transport = packet.transport
    frame.source, frame.destination = packet.source, packet.destination
    if packet.vlan_id is not None:
        frame.vlan_id = packet.vlan_id
    return frame


def frame_view(frame: DecodedFrame) -> Iterator[Tree]:
    """Yield one line for a frame, and its parts below."""
    from rich.text import Text
    from rich.tree import Tree

    tree = Tree(Text(_headline(frame), style="bold"), guide_style="dim")
    for line in _parts(frame):
        tree.add(Text(line))
    if frame.error is not None:
        tree.add(Text(f"error: {frame.error}", style="red"))
    yield tree


def _headline(frame: DecodedFrame) -> str:
    parts = []
    if frame.packet and frame.time is not None:
        at = datetime.fromtimestamp(frame.time or 0, UTC)
        parts.append(f"#{frame.packet} {at:%H:%M:%S.%f}")
    if frame.transport:
        vlan = f" VLAN {frame.vlan_id}" if isinstance(frame.vlan_id, int) else ""
        parts.append(f"{frame.transport}{vlan} {frame.source} → {frame.destination}")
    if frame.type is None:
        return "  ".join([*parts, "not an EtherCAT frame"])
    name = _NAMES.get(frame.type, "undocumented")
    parts.append(f"type {frame.type} ({name}), {frame.length} bytes")
    if frame.publisher:
        parts.append(f"publisher {frame.publisher}, cycle {_cycle(frame)}")
    return "  ".join(parts)


def _cycle(frame: DecodedFrame) -> str:
    cycle = frame.cycle or 0
    if not frame.cycle_order:
        return str(cycle)
    return f"{cycle} (byte-swapped: {int.from_bytes(cycle.to_bytes(2, 'little'))})"


def _parts(frame: DecodedFrame) -> Iterator[str]:
    from eap.pd.authentication import read_signature

    for pd in frame.pds or ():
        if signature := read_signature(pd.id, pd.version, bytes.fromhex(pd.data)):
            at = datetime.fromtimestamp(signature.counter / 1e9, UTC)
            yield f"PD {pd.id}: signature by key {signature.key}, made {at:%Y-%m-%d %H:%M:%S.%f}"
            continue
        yield (
            f"PD {pd.id} (0x{pd.id:04x})  version {pd.version}  "
            f"quality {pd.quality / 10:g} ms  {_octets(pd.data)}"
        )
    yield from map(_datagram_line, frame.datagrams or ())
    packet = frame.ams
    if message := frame.mailbox:
        packet = packet or message.ams
        data = "" if message.ams else f"  {_octets(message.data)}"
        service = f" {message.service}" if message.service else ""
        yield (
            f"{message.protocol}{service}  address {message.address}  counter {message.counter}  "
            f"priority {message.priority}{data}"
        )
        if isinstance(message.detail, int):
            yield f"refused: {message.reason} (0x{message.detail:04x})"
    if packet:
        yield _ams_line(packet)
    if isinstance(frame.data, str):
        yield _octets(frame.data)


def _datagram_line(datagram: DecodedDatagram) -> str:
    if isinstance(datagram.address, int):
        where = f"address 0x{datagram.address:08x}"
    else:
        where = f"ADP 0x{datagram.adp or 0:04x}  ADO 0x{datagram.ado or 0:04x}"
    return (
        f"{datagram.command}  index {datagram.index}  {where}  WKC {datagram.wkc}  "
        f"{_octets(datagram.data)}"
    )


def _ams_line(packet: DecodedAms) -> str:
    direction = "response" if packet.state_flags & 1 else "request"
    return (
        f"AMS {packet.service} {direction} {packet.invoke_id}  "
        f"{packet.source}:{packet.source_port} → "
        f"{packet.target}:{packet.target_port}  error 0x{packet.error_code:x}  "
        f"{_octets(packet.data)}"
    )


def _octets(digits: str) -> str:
    size = len(digits) // 2
    pairs = " ".join(digits[at : at + 2] for at in range(0, min(size, _SHOWN_OCTETS) * 2, 2))
    more = f" … ({size} bytes)" if size > _SHOWN_OCTETS else ""
    return f"[{pairs}{more}]"
