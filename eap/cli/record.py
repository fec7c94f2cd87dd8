"""The ``eapctl record`` group."""

from __future__ import annotations

import click

from eap.cli.group import LazyGroup


@click.group(
    cls=LazyGroup,
    commands_at={
        "info": "eap.cli.recordings:info",
        "repair": "eap.cli.recordings:repair",
    },
)
def record() -> None:
    """Record values and frames, and describe recordings.

    Values are recorded in MCAP files, which PlotJuggler and Foxglove open, frames in pcapng files,
    which Wireshark opens.
    """
