"""PDs that the stations of a plant publish, with the variables in them.

A recording of frames holds them as JSON, so that its frames become values, and a recording of
values, so that its values become frames again.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby

import msgspec
from msgspec import Struct

from eap.codec import datatypes
from eap.pd.layout import ImageLayout
from eap.recording.messages import PlacedVariable, RecordedVariable


class RecordedPd(Struct, frozen=True, kw_only=True):
    """One PD: its identification, and its variables in the order of its data.

    *period_us* is the distance of its frames, 0 if it is not sent by a schedule.
    """

    name: str
    pd_id: int
    version: int
    size: int
    variables: tuple[RecordedVariable, ...]
    period_us: int = 0

    def placed(self) -> list[PlacedVariable]:
        """Return the variables with their first bits in the data of the PD."""
        types = [datatypes.parse(variable.type) for variable in self.variables]
        offsets = datatypes.layout(types).bit_offsets
        return [
            PlacedVariable(variable, offset)
            for variable, offset in zip(self.variables, offsets, strict=True)
        ]


class RecordedFrame(Struct, frozen=True, kw_only=True):
    """One frame: its sender, its destination, and its PDs in order.

    *publisher* is the NetID of the port.
    """

    station: str
    port: str
    publisher: str
    interface: str
    name: str
    destination: str
    pds: tuple[RecordedPd, ...]


def published_by(layouts: Iterable[ImageLayout]) -> tuple[RecordedFrame, ...]:
    """Return all frames of the stations with these images."""
    return tuple(frame for layout in layouts for frame in _frames(layout))


def _frames(layout: ImageLayout) -> Iterable[RecordedFrame]:
    ports = {port.name: port for port in layout.ports}
    frames = {frame.name: frame for frame in layout.frames}
    slots = {slot.name: slot for slot in layout.variables}
    # The PDs of a frame follow each other in the layout.
    for name, pds in groupby(layout.tx, key=lambda pd: pd.frame):
        frame = frames[name]
        port = ports[frame.port]
        yield RecordedFrame(
            station=layout.station,
            port=port.name,
            publisher=port.net_id,
            interface=port.interface,
            name=name,
            destination=frame.destination,
            pds=tuple(
                RecordedPd(
                    name=pd.name,
                    pd_id=pd.pd_id,
                    version=pd.version,
                    size=pd.size,
                    period_us=pd.period_us,
                    variables=tuple(
                        RecordedVariable(each, slots[each].type, slots[each].unit)
                        for each in pd.variables
                    ),
                )
                for pd in pds
            ),
        )


def encode_published(frames: Iterable[RecordedFrame]) -> bytes:
    """Return *frames* as JSON."""
    return msgspec.json.encode(tuple(frames))


def decode_published(octets: bytes) -> tuple[RecordedFrame, ...]:
    """Return the frames of :func:`encode_published`; raise ValueError if *octets* are none."""
    try:
        return msgspec.json.decode(octets, type=tuple[RecordedFrame, ...])
    except (ValueError, RecursionError) as exc:
        raise ValueError(f"the PDs of the plant cannot be read: {exc}") from None
