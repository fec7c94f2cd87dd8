"""What a process of the appliance is to run when it is started: as configured last."""

from __future__ import annotations

import logging

from msgspec.structs import replace

from eap.appliance.change import needs_new_start
from eap.appliance.handover import Handover
from eap.appliance.store import effective
from eap.appliance.trial import why_not_built

logger = logging.getLogger(__name__)


def what_runs_now(handover: Handover) -> Handover:
    """Return *handover* with each station as it was configured last, since the plant file or now.

    A configuration that needs other sockets than those that were opened, or that no engine could
    ever run, is none of this start.
    """
    specs = []
    states = {}
    stored = effective(handover.plant, handover.stations, handover.first_state)
    for given, found in zip(handover.stations, stored, strict=True):
        reasons = needs_new_start(given, found.spec)
        if found.spec != given:
            reasons = reasons or why_not_built(found.spec)
        for reason in reasons:
            logger.warning("station %s: the plant file runs: %s", given.name, reason)
        specs.append(given if reasons else found.spec)
        states[given.name] = found.state
    return replace(handover, stations=tuple(specs), states=states)
