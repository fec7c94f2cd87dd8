"""How the master of a bus port works: what it expects, and what follows from the cycle."""

from __future__ import annotations

from devicebus.master.bus import MasterSettings
from devicebus.master.expected import ExpectedSlave
from eap.ids import InterfaceUri
from eap.pd.spec import BusPortSpec, PortSpec

_MIN_BUDGET, _BUDGET_PER_US = 1536, 3
_MIN_PATIENCE_NS, _MAX_PATIENCE_NS = 5_000_000, 50_000_000
_PROCESS_PATIENCE_NS = 30_000_000
"""Slaves that are a process are late when the machine is busy, and that is no loss."""


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
    is_wire = InterfaceUri.parse(port.interface).scheme == "ethernet"
    least_ns = _MIN_PATIENCE_NS if is_wire else _PROCESS_PATIENCE_NS
    patience_ns = min(max(2_000 * cycle_us, least_ns), _MAX_PATIENCE_NS)
    return MasterSettings(
        expected=expected,
        frame_timeout_ns=patience_ns,
        acyclic_octets=max(_MIN_BUDGET, _BUDGET_PER_US * cycle_us),
        clocks=spec.clocks,
        epoch_offset_ns=epoch_offset_ns,
    )
