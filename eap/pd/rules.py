"""Rules for the frames and PDs of a station, in plant file and dictionaries alike.

Each function yields the violations of a few related rules.  A violation names the key of the plant
file; the table of the profile maps it to an entry of the dictionary.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterable, Iterator
from ipaddress import IPv4Address
from typing import NamedTuple, TypeVar

from eap.codec.ethercat import MAX_ETHERNET_FRAME, MAX_UDP_FRAME, EtherCatHeader
from eap.codec.pd import FIRST_PD, PdHeader
from eap.ids import Destination, DestinationKind, InterfaceUri, MacAddr
from eap.pd.authentication import SIGNATURE_ID
from eap.pd.device import FaultCode
from eap.pd.layout import FRAME_CTRL, VAR_CTRL
from eap.pd.spec import REQUESTER, TxFrameSpec, TxPdSpec

NAME = "a text without spaces and slashes"
MADE_SUFFIXES = (VAR_CTRL, FRAME_CTRL)
MAX_STREAM_FRAME = EtherCatHeader.SIZE + 0x7FF
"""Limit of the 11 bits of Length, where the wire has no lower one."""
MIN_MONITOR_INTERVAL_MS = 100
DESTINATIONS = {
    "udp": (DestinationKind.IP, DestinationKind.TCP),
    "tcp": (DestinationKind.TCP,),
    "ethernet": (DestinationKind.MAC, DestinationKind.NET_ID),
    "loop": (DestinationKind.MAC,),
}
"""Kinds of address to which a port on each kind of interface can send."""
_PD_OVERHEAD = FIRST_PD + PdHeader.SIZE
_NAME = re.compile(r"[^\s/]+")
_Item = TypeVar("_Item")


class RuleViolation(NamedTuple):
    """A violation of a rule."""

    code: FaultCode
    key: str
    """Key of the plant file, below the section of the checked object."""
    message: str
    expected: str
    entry: str = ""
    """Key of the entry at which a dictionary reports it, if that is another than *key*."""


def is_name(text: str) -> bool:
    """Return whether *text* can be the name of a station, a port, a frame, a PD or a variable."""
    return _NAME.fullmatch(text) is not None


def plain_name(text: str, default: str) -> str:
    """Return *text* as a name: without spaces, slashes and dots; *default* if nothing is left."""
    return re.sub(r"[^\w-]+", "_", text).strip("_") or default


def plant_name_of(stem: str) -> str:
    """Return the name of a plant whose file has the name *stem*, without suffix."""
    return stem if is_name(stem) else plain_name(stem, "plant")


def is_group(text: str, scheme: str) -> bool:
    """Return whether *text* is a multicast address that a port on *scheme* can join."""
    try:
        if scheme == "ethernet":
            return MacAddr.parse(text).is_group
        return scheme == "udp" and IPv4Address(text).is_multicast
    except ValueError:
        return False


def frame_budget(scheme: str, kind: DestinationKind | None) -> int:
    """Return the bytes of the largest frame that leaves by *scheme*, EtherCAT header included.

    *kind* is None for a frame to the requester: by any way that leads to such a port.
    """
    if kind is DestinationKind.TCP or scheme in {"loop", "tcp"}:
        return MAX_STREAM_FRAME
    return MAX_ETHERNET_FRAME if scheme == "ethernet" else MAX_UDP_FRAME


def data_budget(scheme: str) -> int:
    """Return the bytes of data of the largest PD that a port on *scheme* can carry."""
    largest = MAX_ETHERNET_FRAME if scheme == "ethernet" else MAX_STREAM_FRAME
    return largest - _PD_OVERHEAD


def duplicates(items: Iterable[tuple[Hashable, _Item]]) -> Iterator[tuple[_Item, _Item]]:
    """Yield each item whose key is that of an earlier one, with the first of that key."""
    first: dict[Hashable, _Item] = {}
    for key, item in items:
        if key in first:
            yield item, first[key]
        else:
            first[key] = item


def check_phase(cycle_us: int, phase_us: int) -> Iterator[RuleViolation]:
    """The phase of a station is within its cycle."""
    if phase_us >= cycle_us:
        message = f"phase_us {phase_us} is not within the cycle"
        yield RuleViolation(FaultCode.CYCLE_TIME, "phase_us", message, f"less than {cycle_us}")


def check_frame(frame: TxFrameSpec, modulo: int | None) -> Iterator[RuleViolation]:
    """Yield the violations of the rules that *frame* has to meet by itself and with its PDs.

    Plant file and dictionary both call this function: a new rule is called here.  *modulo* is None
    if none is given.
    """
    yield from check_modulo(frame.name, frame.divider, modulo)
    yield from check_answers(frame)
    yield from check_signed(frame)


def check_pd(pd: TxPdSpec, modulo: int | None) -> Iterator[RuleViolation]:
    """Yield the violations of the rules that *pd* has to meet by itself, as :func:`check_frame`."""
    yield from check_polled(pd)
    yield from check_triggers(pd)
    yield from check_modulo(pd.name, pd.trigger.divider, modulo)


def check_modulo(name: str, divider: int | None, modulo: int | None) -> Iterator[RuleViolation]:
    """A modulo is one of its divider."""
    if modulo is None:
        return
    if not divider:
        message = f"{name!r} has a modulo but no divider"
        yield RuleViolation(FaultCode.MODULO, "modulo", message, "both or none")
    elif modulo >= divider:
        message = f"modulo {modulo} of {name!r} never comes up"
        yield RuleViolation(
            FaultCode.MODULO, "modulo", message, f"less than the divider, {divider}"
        )


def check_answers(frame: TxFrameSpec) -> Iterator[RuleViolation]:
    """A frame of answers leaves with the request, and in no rhythm of its own."""
    if frame.destination == REQUESTER and frame.divider:
        message = f"frame {frame.name!r} carries answers and has a divider"
        expected = "none: an answer leaves in the cycle that the request is taken in"
        yield RuleViolation(FaultCode.TRIGGERS, "divider", message, expected)


def check_signed(frame: TxFrameSpec) -> Iterator[RuleViolation]:
    """A signed frame has no other PD with the ID of its signature."""
    if frame.sign and any(pd.pd_id == SIGNATURE_ID for pd in frame.pds):
        message = f"frame {frame.name!r} is signed and carries a PD with id {SIGNATURE_ID}"
        expected = f"another id: the signature is PD {SIGNATURE_ID}"
        yield RuleViolation(FaultCode.PD_ID_TWICE, "sign", message, expected)


def check_frame_of(pd: TxPdSpec, frame: TxFrameSpec, line: str = "") -> Iterator[RuleViolation]:
    """Answers, and nothing else, are in frames to the requester; *line* says where *frame* is."""
    if bool(pd.poll_request) is (frame.destination == REQUESTER):
        return
    if pd.poll_request:
        message = f"PD {pd.name!r} is polled, but frame {frame.name!r} goes to {frame.destination}"
        message += f" ({line})" if line else ""
        expected = f"a frame to: {REQUESTER}"
    else:
        where = f"frame {frame.name!r}{', ' if line else ''}{line}"
        message = f"PD {pd.name!r} goes to the requester ({where}), but nothing polls it"
        expected = "poll: the subscription that requests it, or another frame"
    # The dictionary has the destination at the frame, while the plant file names the frame at the
    # PD.
    yield RuleViolation(FaultCode.POLL, "frame", message, expected, entry="to")


def check_monitoring(
    frame: TxFrameSpec, destination: Destination | None, uri: InterfaceUri
) -> Iterator[RuleViolation]:
    """Monitoring needs one unicast subscriber; *destination* is None for the requester."""
    key, interval = "monitor_interval_ms", frame.monitor_interval_ms
    message = f"frame {frame.name!r} is monitored but goes to "
    code = FaultCode.MONITORING
    if 0 < interval < MIN_MONITOR_INTERVAL_MS:
        expected = f"at least {MIN_MONITOR_INTERVAL_MS}, or 0 for never"
        yield RuleViolation(code, key, f"monitor_interval_ms is {interval}", expected)
    elif interval and destination is None:
        yield RuleViolation(
            code, key, f"{message}the requester", "monitoring only of a unicast frame"
        )
    elif interval and destination is not None:
        if destination.is_group:
            yield RuleViolation(
                code, key, f"{message}a group", "monitoring only of a unicast frame"
            )
        # The connection itself shows whether the peer is there.
        elif destination.kind is DestinationKind.TCP or uri.scheme == "loop":
            yield RuleViolation(code, key, f"{message}{destination} by {uri}", "Ethernet or UDP")
    if not frame.monitor_ip:
        return
    if uri.scheme != "ethernet":
        message = f"frame {frame.name!r} has a monitor_ip, but its destination is an IP address"
        yield RuleViolation(code, "monitor_ip", message, "monitor_ip only on Ethernet")
    elif not interval:
        message = f"frame {frame.name!r} has a monitor_ip but no monitor_interval_ms"
        yield RuleViolation(code, "monitor_ip", message, "both or none")


def check_triggers(pd: TxPdSpec) -> Iterator[RuleViolation]:
    """Triggers of a PD that exclude each other."""
    trigger, on_change, code = pd.trigger, pd.trigger.on_change, FaultCode.TRIGGERS
    # TwinCAT leaves overlapping triggers undefined; here they are errors (docs/triggers.md).
    if trigger.cycle_us and trigger.divider:
        message = f"PD {pd.name!r} has a cycle_us and a divider"
        yield RuleViolation(code, "divider", message, "one of the two")
    if on_change is None:
        return
    for key in ("cycle_us", "divider"):
        if getattr(trigger, key):
            message = f"PD {pd.name!r} is sent on change and has a {key}"
            expected = "on_change.timeout_ms for sending it again"
            yield RuleViolation(code, key, message, expected, entry="on_change")
    if 0 < on_change.timeout_ms * 1000 < on_change.inhibit_us:
        message = f"PD {pd.name!r} is to be sent again before changes may be"
        expected = f"timeout_ms of at least {-(-on_change.inhibit_us // 1000)}"
        yield RuleViolation(FaultCode.TIME_OUT, "on_change.timeout_ms", message, expected)


def check_polled(pd: TxPdSpec) -> Iterator[RuleViolation]:
    """An answer has no other trigger."""
    if not pd.poll_request:
        return
    for key in ("cycle_us", "divider", "on_change", "event"):
        if getattr(pd.trigger, key):
            message = f"PD {pd.name!r} has both poll and {key}"
            yield RuleViolation(FaultCode.TRIGGERS, key, message, "one of the two", entry="poll")


def check_times(pd: TxPdSpec, frame: TxFrameSpec | None, cycle_us: int) -> Iterator[RuleViolation]:
    """A PD is due in cycles of the device in which its frame leaves.

    The message of a GATE ends with the divider of *frame*; None leaves that rule out.
    """
    trigger = pd.trigger
    if trigger.cycle_us % cycle_us:
        below = max(trigger.cycle_us // cycle_us, 1) * cycle_us
        is_between = below < trigger.cycle_us
        expected = f"{below} or {below + cycle_us}" if is_between else str(below)
        message = f"cycle_us {trigger.cycle_us} of PD {pd.name!r} is no multiple of the device"
        yield RuleViolation(
            FaultCode.CYCLE_TIME, "cycle_us", f"{message} cycle, {cycle_us}", expected
        )
        return
    step = trigger.divider or trigger.cycle_us // cycle_us
    if frame is None or not frame.divider or not step:
        return
    key = "divider" if trigger.divider else "cycle_us"
    gate = f"but frame {frame.name!r} leaves only every {frame.divider} cycles"
    if step % frame.divider:
        multiple = frame.divider * (1 if trigger.divider else cycle_us)
        message = f"PD {pd.name!r} is due every {step} cycles, {gate}"
        yield RuleViolation(FaultCode.GATE, key, message, f"a multiple of {multiple}")
    elif trigger.modulo % frame.divider != frame.modulo:
        message = f"PD {pd.name!r} is due at {trigger.modulo} of {step} cycles, {gate}"
        expected = f"a modulo that leaves {frame.modulo} when divided by {frame.divider}"
        shown = "modulo" if trigger.modulo else key
        yield RuleViolation(FaultCode.GATE, shown, message, expected, entry=key)


def check_time_out(name: str, timeout_ms: int, cycle_us: int) -> Iterator[RuleViolation]:
    """A time-out is no shorter than the device cycle in which it is looked at."""
    if 0 < timeout_ms * 1000 < cycle_us:
        message = f"timeout_ms {timeout_ms} of {name!r} is shorter than the device cycle of"
        expected = f"at least {-(-cycle_us // 1000)}, or 0 for never"
        yield RuleViolation(FaultCode.TIME_OUT, "timeout_ms", f"{message} {cycle_us} us", expected)
