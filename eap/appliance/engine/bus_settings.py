"""How the master of a bus port works: what it expects, and what follows from the cycle."""

from __future__ import annotations

from devicebus.master.bus import MasterSettings
from devicebus.master.expected import ExpectedSlave
from eap.pd.spec import BusPortSpec, PortSpec

_MIN_BUDGET, _BUDGET_PER_US = 1536, 3


def master_settings(port: PortSpec, cycle_us: int, epoch_offset_ns: int = 0) -> MasterSettings:
    """Return how the master of *port* works, which exchanges process data every *cycle_us*.

    *epoch_offset_ns* leads from the engine's clock to the time since 2000.
    """
    spec = port.bus or BusPortSpec()
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
    return MasterSettings(
        expected=expected,
        frame_timeout_ns=1000 * spec.frame_timeout_us,
        frame_retries=spec.frame_retries,
        acyclic_octets=max(_MIN_BUDGET, _BUDGET_PER_US * cycle_us),
        clocks=spec.clocks,
        epoch_offset_ns=epoch_offset_ns,
    )
