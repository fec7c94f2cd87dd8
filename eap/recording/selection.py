"""Variables and ports of a plant that patterns select.

A pattern is ``STATION`` for all of a station, or ``STATION/NAME``; ``*`` stands for any text and
``?`` for one character, in both parts.  A PD of the station may stand for its variables.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from eap.config.record_texts import matcher
from eap.errors import ControlError
from eap.pd.layout import ImageLayout, VariableSlot
from eap.suggest import suggest

_LISTED = 6


def select_variables(layout: ImageLayout, patterns: Sequence[str]) -> list[VariableSlot]:
    """Return the variables of a station that *patterns* select, themselves or by their PD."""
    is_selected = matcher(patterns)
    pds = [(pd.name, pd.variables) for pd in layout.tx]
    pds += [(pd.name, pd.variables) for pd in layout.rx]
    by_pd = {
        variable
        for name, variables in pds
        if patterns and is_selected(f"{layout.station}/{name}")
        for variable in variables
    }
    return [
        slot
        for slot in layout.variables
        if slot.name in by_pd or is_selected(f"{layout.station}/{slot.name}")
    ]


def check_patterns(patterns: Iterable[str], known: Sequence[str], thing: str) -> None:
    """Check that each pattern selects something.

    Args:
        patterns: As above.
        known: All names, as ``STATION/NAME``.
        thing: ``variable`` or ``port``, for the message.

    Raises:
        ControlError: one selects nothing; the message names what comes near.
    """
    for pattern in patterns:
        is_selected = matcher([pattern])
        if any(map(is_selected, known)):
            continue
        stations = list(dict.fromkeys(name.partition("/")[0] for name in known))
        near = suggest(pattern, [*known, *stations])
        listed = ", ".join(stations[:_LISTED]) + (", ..." if len(stations) > _LISTED else "")
        hint = near or f"; stations here: {listed}"
        raise ControlError(f"{pattern}: it selects no {thing}{hint}", code="unknown_name")
