"""Optional processes, which the plant file asks for and the plant does not need."""

from __future__ import annotations

import os
from importlib.util import find_spec
from typing import NamedTuple

import msgspec

from eap.config.load import Plant
from eap.ids import encode_value
from eap.runtime.folder import ApplianceFolder
from eap.runtime.handover import BridgeHandover, InheritedRecord, RecorderHandover, WebHandover
from eap.supervisor.child import Child


class _Extra(NamedTuple):
    """Optional process.

    Attributes:
        module: Has its ``main``.
        needs: Module that must be installed, empty for none.
        extra: Extra that installs it.
    """

    module: str
    needs: str = ""
    extra: str = ""


_EXTRAS = {
    "web": _Extra("eap.web.process", "aiohttp", "web"),
    "metrics": _Extra("eap.web.process", "aiohttp", "web"),
    "recording": _Extra("eap.recording.process", "mcap", "record"),
    "mqtt": _Extra("eap.bridges.mqtt.process", "aiomqtt", "mqtt"),
    "opcua": _Extra("eap.bridges.opcua.process", "asyncua", "opcua"),
    "s7": _Extra("eap.bridges.s7.process"),
    "modbus": _Extra("eap.bridges.modbus.process"),
}
"""Optional processes by their keys in the plant file."""


def optional_processes(
    plant: Plant, folder: ApplianceFolder, bytecode: str
) -> dict[Child, InheritedRecord]:
    """Return the processes that the plant file asks for and the plant does not need."""
    own = os.getpid()
    handovers: dict[str, InheritedRecord] = {}
    if plant.web is not None:
        handovers["web"] = WebHandover(own, str(folder.path), plant.name, web=plant.web)
    if plant.metrics is not None:
        handovers["metrics"] = WebHandover(own, str(folder.path), plant.name, metrics=plant.metrics)
    for name, section in plant.bridges.items():
        raw = msgspec.Raw(msgspec.json.encode(section, enc_hook=encode_value))
        handovers[name] = BridgeHandover(own, str(folder.path), plant.name, name, raw)
    for record in plant.record:
        handover = RecorderHandover(own, str(folder.path), plant.name, record)
        handovers[f"recording {record.name}"] = handover
    return {
        Child(name, _EXTRAS[_kind_of(name)].module, bytecode): each
        for name, each in handovers.items()
    }


def _kind_of(process: str) -> str:
    """Return the kind of an optional process, of which there may be several."""
    return process.partition(" ")[0]


def missing_extra(process: str) -> str:
    """Return why an optional process cannot run, empty if all that it needs is installed."""
    _, needs, extra = _EXTRAS[_kind_of(process)]
    if not needs or find_spec(needs) is not None:
        return ""
    return f"{needs} is not installed: pip install 'eap-appliance[{extra}]'"
