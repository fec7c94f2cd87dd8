"""Status and lists of a station, from the counters of its process image.

docs/control.md describes the JSON shapes, which are a contract.
"""

from __future__ import annotations

from collections.abc import Iterable
from operator import itemgetter
from typing import Any, Literal

import msgspec
from msgspec import UNSET, UnsetType

from eap.codec import datatypes
from eap.pd.address import from_word, source_text
from eap.pd.device import DeviceState
from eap.pd.image import Image
from eap.pd.layout import FieldSlot, FrameSlot, RxSlot, TxSlot
from eap.pd.monitor import SubscriberPresence
from eap.pd.quality import is_late, quality, tracker_word
from eap.pd.words import (
    HISTOGRAM_BINS,
    PD_DROP_REASONS,
    REASON_INDEX,
    REASONS,
    FrameState,
    FrameWord,
    Reason,
    RxState,
    RxWord,
    StationWord,
    TxWord,
    percentile,
)


class MemberRow(msgspec.Struct, frozen=True):
    """Member of a struct: its path, and its place from the start of the variable in bits."""

    name: str
    type: str
    bit_offset: int
    bits: int


class PdRowVariable(msgspec.Struct, frozen=True):
    """Variable of a PD; *type* is the name of a type with a definition."""

    name: str
    type: str
    unit: str
    writer: str
    members: list[MemberRow] | UnsetType = UNSET


class PdRow(msgspec.Struct, frozen=True, kw_only=True):
    """PD with its identification; *frame* and *destination* of one to send."""

    station: str
    direction: Literal["tx", "rx"]
    name: str
    id: int
    version: int
    length: int
    port: str
    poll: str | None
    publisher: str | None
    frame: str | UnsetType = UNSET
    destination: str | UnsetType = UNSET
    variables: list[PdRowVariable]


def station_status(image: Image, now_ns: int, wall_ns: int | None = None) -> dict[str, Any]:
    """Return one station's entry of ``eapctl status``.

    Args:
        image: A snapshot of the station's image, so that all belongs to one moment.
        now_ns: The time on the monotonic clock.
        wall_ns: The same moment since 1970; without it nothing is dated.
    """
    layout, words = image.layout, image.words
    state = words[StationWord.STATE]
    lateness = words[StationWord.LATENESS : StationWord.LATENESS + HISTOGRAM_BINS].tolist()
    return {
        "name": layout.station,
        "net_id": layout.net_id,
        "state": DeviceState(state).name if state else DeviceState.INIT.name,
        "cycle": words[StationWord.CYCLE],
        "cycle_us": layout.cycle_us,
        "overruns": words[StationWord.OVERRUNS],
        "restarts": words[StationWord.RESTARTS],
        "torn": words[StationWord.TORN],
        "signing_key": words[StationWord.SIGNING_KEY] or None,
        "links_held": words[StationWord.LINKS_HELD],
        "lateness_us": _spread(lateness, words[StationWord.LATENESS_MAX_NS] // 1000),
        "ports": [
            {"name": p.name, "kind": p.kind, "net_id": p.net_id, "interface": p.interface}
            for p in layout.ports
        ],
        "discarded": _discarded(image, StationWord.DISCARDED),
        **_controllers(image, now_ns),
        "frames": [frame_status(image, slot) for slot in layout.frames],
        "pd": {
            "tx": [tx_status(image, slot) for slot in layout.tx],
            "rx": [_rx(image, slot, now_ns, wall_ns) for slot in layout.rx],
        },
    }


def group_list(images: Iterable[Image]) -> list[dict[str, Any]]:
    """Return the groups of stations that one wake-up of the engine serves, by cycle and phase.

    A station is in none before its first cycle.  One that follows the clock of a bus has the phase
    of its latest cycle.
    """
    groups: dict[tuple[int, int], list[Image]] = {}
    for image in images:
        cycle_us = image.layout.cycle_us
        if at_ns := image.words[StationWord.CYCLE_AT_NS]:
            groups.setdefault((cycle_us, at_ns // 1000 % cycle_us), []).append(image)
    return [
        {
            "cycle_us": cycle_us,
            "phase_us": phase_us,
            "stations": [image.layout.station for image in group],
            "last_us": max(image.words[StationWord.BEHIND_NS] for image in group) // 1000,
        }
        for (cycle_us, phase_us), group in sorted(groups.items(), key=itemgetter(0))
    ]


def _controllers(image: Image, now_ns: int) -> dict[str, Any]:
    """Return the controllers that the station reads, nothing if there are none."""
    by_name: dict[str, list[FieldSlot]] = {}
    for slot in image.layout.fields:
        by_name.setdefault(slot.controller, []).append(slot)
    if not by_name:
        return {}
    return {"controllers": [_controller(image, name, s, now_ns) for name, s in by_name.items()]}


def _controller(image: Image, name: str, slots: list[FieldSlot], now_ns: int) -> dict[str, Any]:
    moments = [image.words[slot.words] for slot in slots]
    return {
        "name": name,
        "sources": len(slots),
        "late": sum(is_late(image, slot) for slot in slots),
        "age_us": max(now_ns - min(moments), 0) // 1000 if all(moments) else None,
    }


def pd_list(image: Image) -> list[PdRow]:
    """Return every PD of the station with its identification and its variables."""
    layout = image.layout
    net_ids = {port.name: port.net_id for port in layout.ports}
    destinations = {frame.name: frame.destination for frame in layout.frames}

    def row(slot: TxSlot | RxSlot, **direction: Any) -> PdRow:
        slots = (image.slots[name] for name in slot.variables)
        return PdRow(
            station=layout.station,
            name=slot.name,
            id=slot.pd_id,
            version=slot.version,
            length=slot.size,
            port=slot.port,
            poll=slot.poll_request or None,
            variables=[
                PdRowVariable(p.name, datatypes.parse(p.type).name, p.unit, p.writer) for p in slots
            ],
            **direction,
        )

    sent = [
        row(
            slot,
            direction="tx",
            publisher=net_ids[slot.port],
            frame=slot.frame,
            destination=destinations[slot.frame],
        )
        for slot in layout.tx
    ]
    received = [row(slot, direction="rx", publisher=slot.publisher or None) for slot in layout.rx]
    return sent + received


def var_state(image: Image, slot: RxSlot) -> int:
    """Return VarState: bit 0 version, bit 1 length differ in what arrives now; 0 is well."""
    words = image.words
    first = tracker_word(image, slot)
    if words[slot.words + RxWord.MISMATCH_AT_NS] <= words[first + RxWord.ARRIVED_AT_NS]:
        return 0
    return int(words[slot.words + RxWord.MISMATCH])


def _spread(bins: list[int], largest: int) -> dict[str, int | None]:
    """Return percentiles of a histogram; bins are wider than the largest value is exact."""
    p50, p99 = percentile(bins, 0.5), percentile(bins, 0.99)
    if p50 is None or p99 is None:
        return {"p50": None, "p99": None, "max": None}
    return {"p50": min(p50, largest), "p99": min(p99, largest), "max": largest}


def _discarded(image: Image, first: int) -> dict[str, int]:
    counts = image.words[first : first + len(PD_DROP_REASONS)].tolist()
    return {
        reason.value: count for reason, count in zip(PD_DROP_REASONS, counts, strict=True) if count
    }


def tx_status(image: Image, slot: TxSlot) -> dict[str, Any]:
    """Return the entry of one PD to send in the status of the station."""
    words = image.words
    counts = words[slot.words + TxWord.REASON : slot.words + TxWord.SIZE].tolist()
    whole = 0 if slot.poll_request else words[slot.frame_words + FrameWord.WHOLE]
    scheduled = REASON_INDEX[Reason.CYCLE if slot.cyclic else Reason.DIVIDER]
    # Frames that leave whole count once for all their PDs, see publisher.py.
    counts[scheduled] += whole
    last = words[slot.words + TxWord.LAST_REASON] if not whole else scheduled
    return {
        "name": slot.name,
        "port": slot.port,
        "frame": slot.frame,
        "sent": sum(counts),
        "skipped": words[slot.words + TxWord.SKIPPED],
        "reason": {r.value: n for r, n in zip(REASONS, counts, strict=True) if n},
        "last_reason": REASONS[last].value if sum(counts) else None,
        "var_state": tx_var_state(words, slot),
        "frame_state": frame_state(image, slot.frame_words),
        "subscriber": presence(image, slot.frame_words),
    }


def _rx(image: Image, slot: RxSlot, now_ns: int, wall_ns: int | None) -> dict[str, Any]:
    words = image.words
    first = tracker_word(image, slot)
    received = words[first + RxWord.RECEIVED]
    bins = words[first + RxWord.JITTER : first + RxWord.JITTER + HISTOGRAM_BINS].tolist()
    age_ns = now_ns - words[first + RxWord.ARRIVED_AT_NS]
    spread = _spread(bins, words[first + RxWord.JITTER_MAX_US])
    response_ns = words[slot.words + RxWord.RESPONSE_NS]
    last_us = response_ns // 1000 if response_ns else None
    return {
        "name": slot.name,
        "port": slot.port,
        "received": received,
        "lost": words[first + RxWord.LOST] if slot.step else None,
        "duplicated": words[first + RxWord.DUPLICATED],
        "reordered": words[first + RxWord.REORDERED],
        "late": words[first + RxWord.LATE],
        "timeouts": words[first + RxWord.TIMEOUTS],
        "repeated": words[first + RxWord.REPEATED],
        "discarded": _discarded(image, slot.words + RxWord.DISCARDED),
        "quality": quality(image, slot) if received else None,
        "cycle_index": words[first + RxWord.LAST_CYCLE] & 0xFFFF if received else None,
        "var_state": var_state(image, slot),
        "age_us": max(age_ns, 0) // 1000 if received else None,
        "last_good": round((wall_ns - age_ns) / 1e9, 3) if received and wall_ns else None,
        # Answers have no rhythm to deviate from; the same words hold their response times.
        "jitter_us": _spread([], 0) if slot.poll_request else spread,
        "response_us": {"last": last_us, **spread} if slot.poll_request else None,
        "source": source_text(words[slot.words + RxWord.SOURCE]),
        "other_source": _seen(words, slot, RxWord.OTHER_SOURCE, RxWord.OTHER_SOURCE_AT_NS, now_ns),
        "wrong_source": _seen(words, slot, RxWord.WRONG_SOURCE, RxWord.WRONG_SOURCE_AT_NS, now_ns),
        "state": RxState(words[first + RxWord.STATE]).name.lower(),
    }


def _seen(
    words: memoryview, slot: RxSlot, address: RxWord, at: RxWord, now_ns: int
) -> dict[str, Any] | None:
    """Return an address that frames came from and how long ago, None if there was none."""
    text = source_text(words[slot.words + address])
    if text is None:
        return None
    age_ns = now_ns - words[slot.words + at]
    return {"address": text, "age_us": max(age_ns, 0) // 1000}


def unsent_state(words: memoryview, first_word: int) -> FrameState:
    """Return the reason the frame with first word *first_word* was not sent, 0 if it was sent."""
    if words[first_word + FrameWord.UNSENT_AT_NS] < words[first_word + FrameWord.SENT_AT_NS]:
        return FrameState(0)
    return FrameState(words[first_word + FrameWord.UNSENT])


def tx_var_state(words: memoryview, pd: TxSlot) -> int:
    """Return VarState of *pd*: bit 0 not sent when it was due last."""
    unsent_at_ns = words[pd.words + TxWord.UNSENT_AT_NS]
    sent_at_ns = words[pd.words + TxWord.SENT_AT_NS]
    if words[pd.frame_words + FrameWord.WHOLE] and not pd.poll_request:
        # Its frame has gone whole: then all PDs of it are due in the same cycles.
        sent_at_ns = max(sent_at_ns, words[pd.frame_words + FrameWord.SENT_AT_NS])
    return int(unsent_at_ns > 0 and unsent_at_ns >= sent_at_ns)


def frame_state(image: Image, first_word: int) -> int:
    """Return the FrameState of the frame whose first word is at index *first_word*."""
    is_missing = image.words[first_word + FrameWord.PRESENCE] == SubscriberPresence.MISSING
    missing = FrameState.SUBSCRIBER_MISSING if is_missing else 0
    return int(unsent_state(image.words, first_word) | missing)


def presence(image: Image, first_word: int) -> str:
    """Return whether the subscriber of that frame is there; ``unknown`` too without monitoring."""
    return SubscriberPresence(image.words[first_word + FrameWord.PRESENCE]).name.lower()


def frame_status(image: Image, slot: FrameSlot) -> dict[str, Any]:
    """Return one frame's entry of ``eapctl status``.

    ``address`` is where it goes at present, null while the one behind a NetID is not known.
    """
    words, first = image.words, slot.words
    address = from_word(words[first + FrameWord.ADDRESS])
    return {
        "name": slot.name,
        "port": slot.port,
        "destination": slot.destination,
        "address": None if address is None else str(address),
        "sent": words[first + FrameWord.WHOLE] + words[first + FrameWord.PARTIAL],
        "skipped": words[first + FrameWord.SKIPPED],
        "frame_state": frame_state(image, first),
        "monitor_interval_ms": slot.monitor_interval_ms or None,
        "subscriber": presence(image, first),
    }
