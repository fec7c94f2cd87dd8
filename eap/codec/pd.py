"""EAP process-data frames (EtherCAT frame type 4, once called network variables).

Layout from the public dissector of Wireshark and two open receivers; names follow ETG.1005.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.codec.wire import Buffer, WireStruct, net_id, u8, u16
from eap.errors import MalformedError, TruncatedError


class PdFrameHeader(WireStruct, frozen=True):
    """Publisher of the frame, number of PDs, and the sender's cycle counter.

    *eap_sm* carries the sender's state in newer devices; TwinCAT 2 and Wireshark read it and
    *reserved* as one reserved word.  It is never a reason to refuse a frame.
    """

    publisher: net_id
    count: u16
    cycle: u16
    reserved: u8 = 0
    eap_sm: u8 = 0


class PdHeader(WireStruct, frozen=True):
    """One PD: its identification, the version of its mapping, its length, its quality.

    *quality* is the age of the data in units of 100 us when it was sent.
    """

    pd_id: u16
    version: u16
    length: u16
    quality: u16 = 0


PD_FRAME_START = EtherCatHeader.SIZE
"""Offset of the PD frame header in a frame."""
FIRST_PD = PD_FRAME_START + PdFrameHeader.SIZE
"""Offset of the first PD in a frame."""
CYCLE_OFFSET = PD_FRAME_START + 8
"""Offset of the cycle counter in a frame."""
EAP_SM_OFFSET = PD_FRAME_START + 11
"""Offset of the EAP SM byte in a frame."""


def decode_frame_header(data: Buffer) -> PdFrameHeader:
    """Check the EtherCAT header of a whole frame and return its PD frame header.

    Raises:
        TruncatedError: the frame is shorter than its Length says, or its PDs cannot fit.
        MalformedError: the frame is of another type.
    """
    ethercat = EtherCatHeader.decode(data)
    if ethercat.type != FrameType.PROCESS_DATA:
        raise MalformedError(f"frame type {ethercat.type}, expected 4", layout="EtherCatHeader")
    if PD_FRAME_START + ethercat.length > len(data):
        raise TruncatedError(
            f"length {ethercat.length}, but {len(data) - PD_FRAME_START} bytes follow",
            layout="EtherCatHeader",
        )
    header = PdFrameHeader.decode(data, PD_FRAME_START)
    # A count that cannot fit is refused here, before a loop runs over 65535 PDs.
    needed = PdFrameHeader.SIZE + header.count * PdHeader.SIZE
    if needed > ethercat.length:
        raise TruncatedError(
            f"{header.count} PDs need at least {needed} bytes, length is {ethercat.length}",
            layout="PdFrameHeader",
            offset=PD_FRAME_START,
        )
    return header


def iter_pds(data: Buffer) -> Iterator[tuple[PdHeader, memoryview]]:
    """Yield each PD of a whole frame with a view of its data; nothing is copied.

    Surplus bytes behind the last PD are ignored.

    Raises:
        CodecError: as :func:`decode_frame_header`, or a PD reaches past the frame's Length.
    """
    header = decode_frame_header(data)
    end = PD_FRAME_START + EtherCatHeader.decode(data).length
    view = memoryview(data)[:end]
    offset = FIRST_PD
    for _ in range(header.count):
        pd = PdHeader.decode(view, offset)
        offset += PdHeader.SIZE
        payload = view[offset : offset + pd.length]
        if len(payload) < pd.length:
            raise TruncatedError(
                f"PD {pd.pd_id} has {len(payload)} of {pd.length} bytes",
                layout="PdHeader",
                offset=offset,
            )
        yield pd, payload
        # The next PD follows without alignment, also behind an odd length.
        offset += pd.length


class FollowedFrame(NamedTuple):
    """A frame of process data whose PDs were followed by their own lengths.

    *length* is that of the EtherCAT header, *needed* what its PDs take.  Each PD comes with the
    view of its data that is there: a frame that is cut ends with a short view, or before its last
    PD.
    """

    header: PdFrameHeader
    length: int
    needed: int
    pds: list[tuple[PdHeader, memoryview]]
    is_cut: bool

    @property
    def has_wrong_length(self) -> bool:
        """True if the PDs are all there, but not where the EtherCAT header says."""
        return not self.is_cut and self.needed != self.length


def follow_pds(data: Buffer) -> FollowedFrame:
    """Return the PDs of a frame, whatever its EtherCAT header's Length says.

    For tools that watch a network: some senders write a wrong Length (4 always), and a capture may
    hold the begin of a frame only.  Bytes behind the last PD count as padding where Length covers
    them.

    Raises:
        TruncatedError: the frame ends before its PD frame header does.
        MalformedError: the frame is of another type, or a PD reaches past Length and past its end.
    """
    ethercat = EtherCatHeader.decode(data)
    if ethercat.type != FrameType.PROCESS_DATA:
        raise MalformedError(f"frame type {ethercat.type}, expected 4", layout="EtherCatHeader")
    header = PdFrameHeader.decode(data, PD_FRAME_START)
    view = memoryview(data)
    size, offset = len(view), FIRST_PD
    pds = []
    for _ in range(header.count):
        # Checked first: a count of 65535 must not run on in a short frame.
        if offset + PdHeader.SIZE > size:
            offset += PdHeader.SIZE
            break
        pd = PdHeader.decode(view, offset)
        start = offset + PdHeader.SIZE
        offset = start + pd.length
        pds.append((pd, view[start : min(offset, size)]))
    is_cut = offset > size
    announced = PD_FRAME_START + ethercat.length
    if is_cut and announced <= size:
        raise MalformedError(
            f"{header.count} PDs reach past the {size} bytes of the frame",
            layout="PdFrameHeader",
            offset=PD_FRAME_START,
        )
    needed = offset - PD_FRAME_START
    if not is_cut and needed < ethercat.length and announced <= size:
        needed = ethercat.length  # what later versions may add behind the last PD
    return FollowedFrame(header, ethercat.length, needed, pds, is_cut)


def encode_frame(header: PdFrameHeader, pds: list[tuple[PdHeader, bytes]]) -> bytes:
    """Return a whole frame; *count* and the lengths are set from *pds*.

    For tests and tools: the publisher patches prebuilt frames instead.
    """
    body = b"".join(
        PdHeader(pd.pd_id, pd.version, len(data), pd.quality).encode() + data for pd, data in pds
    )
    fixed = PdFrameHeader(
        header.publisher, len(pds), header.cycle, header.reserved, header.eap_sm
    ).encode()
    return EtherCatHeader(len(fixed) + len(body)).encode() + fixed + body
