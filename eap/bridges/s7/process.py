"""Process of the bridge ``s7``."""

from __future__ import annotations

from eap.bridges.bridge import Bridge
from eap.bridges.field.process import run_field
from eap.bridges.process import run_bridge
from eap.bridges.s7.link import S7Link
from eap.bridges.s7.session import S7Session
from eap.config.bridge_sections import S7Bridge
from eap.runtime.startup import Startup


def main(descriptor: int, startup: Startup) -> int:
    """Run the bridge until SIGTERM, or until its supervisor ends; return the exit code."""
    return run_bridge(descriptor, startup, S7Bridge, serve)


async def serve(bridge: Bridge, section: S7Bridge) -> None:
    """Read and write controllers, and serve data blocks, until cancelled."""
    await run_field(bridge, "s7", section.controllers, section.server, S7Link, S7Session)
