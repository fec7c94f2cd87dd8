"""The PDs of a frame that nobody has seen yet, one after the other."""

from __future__ import annotations

from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.codec.pd import FIRST_PD, PD_FRAME_START, PdFrameHeader, PdHeader
from eap.errors import TruncatedError
from eap.pd.words import Discard


def walk(data: memoryview, size: int) -> list[tuple[PdHeader, int]] | Discard:
    """Return each PD header with its offset, or why the frame is dropped as a whole."""
    try:
        ethercat = EtherCatHeader.decode(data[:size])
        if ethercat.type != FrameType.PROCESS_DATA:
            return Discard.WRONG_TYPE
        end = PD_FRAME_START + ethercat.length
        frame = data[: min(end, size)]
        count = PdFrameHeader.decode(frame, PD_FRAME_START).count
        if FIRST_PD + count * PdHeader.SIZE > end:
            return Discard.COUNT_TOO_LARGE
        pds = []
        offset = FIRST_PD
        for _ in range(count):
            header = PdHeader.decode(frame, offset)
            pds.append((header, offset))
            offset += PdHeader.SIZE + header.length
    except TruncatedError:
        return Discard.TRUNCATED
    return pds if offset <= end <= size else Discard.TRUNCATED
