"""Settings of the master of a bus port, made of its specification."""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import groupby

from devicebus.master.bus import MasterSettings
from devicebus.master.matching import ExpectedSlave
from devicebus.master.pdo import Pdo, PdoEntry, ProcessDataChannel
from eap.pd.spec import BusPortSpec, BusSlaveSpec, PortSpec

_MIN_BUDGET, _BUDGET_PER_US = 1536, 3
_EPOCH_S = 946_684_800
"""2000-01-01, from which the clocks of slaves count."""


def epoch_offset_ns() -> int:
    """Return the difference between the time since 2000 and the engine's clock."""
    return time.time_ns() - time.monotonic_ns() - _EPOCH_S * 1_000_000_000


def master_settings(port: PortSpec, cycle_us: int, offset_ns: int = 0) -> MasterSettings:
    """Return the settings of the master of *port*, which exchanges data every *cycle_us*.

    *offset_ns* leads from the engine's clock to the time since 2000.
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
            config=slave.config,
            channels=tuple(_channels(slave)),
        )
        for slave in spec.slaves
    ]
    return MasterSettings(
        expected=expected,
        frame_timeout_ns=1000 * spec.frame_timeout_us,
        frame_retries=spec.frame_retries,
        acyclic_octets=max(_MIN_BUDGET, _BUDGET_PER_US * cycle_us),
        clocks=spec.clocks,
        cycle_ns=1000 * cycle_us,
        epoch_offset_ns=offset_ns,
        lock=spec.lock_cycle,
        lead_ns=1000 * spec.sync_lead_us,
        redundant=bool(spec.redundant),
    )


def _channels(slave: BusSlaveSpec) -> Iterator[ProcessDataChannel]:
    """Yield the described process data, for which a place is kept while the slave is absent."""
    for entries, is_output in ((slave.outputs, True), (slave.inputs, False)):
        for manager, mapped in groupby(entries, key=lambda each: each.manager):
            pdo = Pdo(0, tuple(PdoEntry(e.index, e.subindex, e.bit_length) for e in mapped))
            # Its sync manager is read from its EEPROM when it is there.
            yield ProcessDataChannel(manager, 0, 0, is_output, (pdo,))
