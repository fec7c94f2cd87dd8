"""How the master of a bus port works: what it expects, and what follows from the cycle."""

from __future__ import annotations

from devicebus.master.bus import MasterSettings
from devicebus.master.expected import ExpectedSlave
from eap.pd.spec import BusPortSpec

_MIN_BUDGET, _BUDGET_PER_US = 1536, 3
_MIN_PATIENCE_NS, _MAX_PATIENCE_NS = 5_000_000, 50_000_000


def master_settings(spec: BusPortSpec, cycle_us: int, epoch_offset_ns: int = 0) -> MasterSettings:
    """Return how a master works that exchanges process data every *cycle_us*.

    *epoch_offset_ns* leads from the engine's clock to the time since 2000.
    """
    expected = [
        ExpectedSlave(
            name=slave.name,
            vendor=slave.vendor,
            product=slave.product,
            revision=slave.revision,
            serial=slave.serial,
            alias=slave.alias,
        )
        for slave in spec.slaves
    ]
    patience_ns = min(max(2_000 * cycle_us, _MIN_PATIENCE_NS), _MAX_PATIENCE_NS)
    return MasterSettings(
        expected=expected,
        frame_timeout_ns=patience_ns,
        acyclic_octets=max(_MIN_BUDGET, _BUDGET_PER_US * cycle_us),
        clocks=spec.clocks,
        epoch_offset_ns=epoch_offset_ns,
    )
