"""Which entry of a simulated device a person means."""

from __future__ import annotations

from devicebus.sim.device import Device
from devicebus.sim.devices.objects import parse_entry


def find_entry(device: Device, text: str) -> tuple[int, int]:
    """Return index and subindex of an entry.

    Args:
        device: Whose entry it is.
        text: The name of an input or output, that of any other entry, or index and subindex such
            as ``0x6000:1``.

    Raises:
        ValueError: there is none, or several of that name.
    """
    if text in device.channels:
        return device.channels[text]
    if text[:1].isdigit():
        index, subindex = parse_entry(text)
        if index in device.dictionary and subindex in device.dictionary[index].entries:
            return index, subindex
        raise ValueError(f"{device.name} has no entry {index:#06x}:{subindex}")
    named = [
        (item.index, subindex)
        for item in device.dictionary
        for subindex, entry in item.entries.items()
        if entry.name == text
    ]
    if not named:
        known = ", ".join(device.channels) or "none"
        raise ValueError(f"{device.name} has no entry {text!r} (inputs and outputs: {known})")
    if len(named) > 1:
        places = ", ".join(f"{index:#06x}:{subindex}" for index, subindex in named)
        raise ValueError(f"{device.name} has several entries {text!r}: {places}")
    return named[0]
