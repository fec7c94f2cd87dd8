"""What the dictionary of a master shows of the configuration of one slave (ETG.1510, 0x8nnn)."""

from __future__ import annotations

from typing import Any

from devicebus.wire.register import DlStatus
from eap.appliance.bus_request import SlaveReport
from eap.appliance.services.master.master_look import communicating
from eap.appliance.services.master.slave_facts import Facts
from eap.od.profiles.master1100 import Live

_NO_LINK, _NO_COMMUNICATION, _LINK_MISSING, _ADDITIONAL_LINK = 1, 2, 4, 8
_PORT_SHIFT = 4
_PORTS_TO_OTHERS = (1, 2, 3)


def configured_value(slave: SlaveReport, dl: DlStatus, facts: Facts, key: Live) -> Any:
    """Return what *key* stands for; 0 for what nobody knows.

    Args:
        slave: As the engine knows it.
        dl: Its links now.
        facts: What it says about itself.
        key: Of a row of the profile.
    """
    return {
        Live.ADDRESS: slave.station,
        Live.TYPE: slave.order or slave.name,
        Live.NAME: slave.name,
        Live.DEVICE_TYPE: facts.device_type,
        Live.VENDOR: slave.vendor,
        Live.PRODUCT: slave.product,
        Live.REVISION: slave.revision,
        Live.SERIAL: slave.serial,
        # In BOOT they are other ones than in the EEPROM.
        Live.MAILBOX_OUT: slave.to_slave or slave.usual_to_slave,
        Live.MAILBOX_IN: slave.to_master or slave.usual_to_master,
        Live.LINK_STATUS: link_status(slave, dl),
        Live.LINK_PRESET: slave.link_preset,
        Live.PHYSICS: slave.port_physics,
        Live.PROTOCOLS: slave.protocols,
        Live.HAS_HISTORY: facts.has_history,
    }.get(key, 0)


def link_status(slave: SlaveReport, dl: DlStatus) -> int:
    """Return how the links of a slave differ from those it was found with."""
    if not slave.state:
        return _NO_LINK
    alive = communicating(dl)
    status = 0
    for port in _PORTS_TO_OTHERS:
        is_expected = slave.link_preset >> port - 1 & 1
        has_link = dl.link >> port & 1
        if is_expected and not has_link:
            status |= _LINK_MISSING | 1 << _PORT_SHIFT + port
        elif has_link and not is_expected:
            status |= _ADDITIONAL_LINK | 1 << _PORT_SHIFT + port
        elif has_link and not alive >> port & 1:
            status |= _NO_COMMUNICATION | 1 << _PORT_SHIFT + port
    return status
