"""The OPC UA server as a process of the supervisor."""

from __future__ import annotations

from eap.bridges.bridge import Bridge
from eap.bridges.opcua.server import PlantOpcUa
from eap.bridges.process import run_bridge
from eap.config.opcua_sections import OpcUaSection
from eap.runtime.startup import Startup


def main(descriptor: int, startup: Startup) -> int:
    """Serve a plant until SIGTERM, or until its supervisor ends; return the exit code."""
    return run_bridge(descriptor, startup, OpcUaSection, _serve)


async def _serve(bridge: Bridge, section: OpcUaSection) -> None:
    await PlantOpcUa(bridge, section).run()
