"""VoE messages: a vendor's own protocol over EtherCAT (ETG.1000.6)."""

from __future__ import annotations

from eap.codec.wire import WireStruct, u16, u32


class VoeHeader(WireStruct, frozen=True):
    """ETG.1000.6: whose protocol the data behind it is, and which of them."""

    vendor_id: u32
    vendor_type: u16
