"""The ``eapctl record`` group."""

from __future__ import annotations

import click

from eap.cli.group import LazyGroup


@click.group(
    cls=LazyGroup,
    commands_at={
        "info": "eap.cli.recordings:info",
        "list": "eap.cli.recorders:list_recordings",
        "mark": "eap.cli.recorders:mark",
        "repair": "eap.cli.recordings:repair",
        "snapshot": "eap.cli.recorders:snapshot",
        "start": "eap.cli.recorders:start",
        "stop": "eap.cli.recorders:stop",
    },
)
def record() -> None:
    """Record values and frames, and describe recordings.

    Values are recorded in MCAP files, which PlotJuggler and Foxglove open, frames in pcapng files,
    which Wireshark opens.
    """
