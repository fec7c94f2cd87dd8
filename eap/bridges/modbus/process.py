"""Process of the bridge ``modbus``."""

from __future__ import annotations

from eap.bridges.bridge import Bridge
from eap.bridges.field.memory import ServedMemory
from eap.bridges.field.process import run_field
from eap.bridges.modbus.link import ModbusLink
from eap.bridges.modbus.session import ModbusSession
from eap.bridges.process import run_bridge
from eap.config.bridge_sections import ModbusBridge
from eap.runtime.startup import Startup


def main(descriptor: int, startup: Startup) -> int:
    """Run the bridge until SIGTERM, or until its supervisor ends; return the exit code."""
    return run_bridge(descriptor, startup, ModbusBridge, serve)


async def serve(bridge: Bridge, section: ModbusBridge) -> None:
    """Read and write devices, and serve registers, until cancelled."""
    unit = section.server.unit if section.server else 0

    def session(memory: ServedMemory) -> ModbusSession:
        return ModbusSession(memory, unit)

    await run_field(bridge, "modbus", section.controllers, section.server, ModbusLink, session)
