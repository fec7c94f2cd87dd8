"""Which entry of a simulated device a person means."""

from __future__ import annotations

from devicebus.sim.device import Device
from eap.ids import ObjectId


def find_entry(device: Device, text: str) -> tuple[int, int]:
    """Return index and subindex of an entry.

    Args:
        device: Whose entry it is.
        text: The name of an input or output, that of any other entry, or index and subindex such
            as ``0x6000:01``; of an index that begins with a letter, 0x or the subindex too.

    Raises:
        ValueError: there is none, or several of that name.
    """
    if text in device.channels:
        return device.channels[text]
    named = [
        ObjectId(item.index, subindex)
        for item in device.dictionary
        for subindex, entry in item.entries.items()
        if entry.name == text
    ]
    if not named and (text[:1].isdigit() or ":" in text):
        index, subindex = entry = ObjectId.parse(text)
        if index in device.dictionary and subindex in device.dictionary[index].entries:
            return entry
        raise ValueError(f"{device.name} has no entry {entry}")
    if not named:
        known = ", ".join(device.channels) or "none"
        raise ValueError(f"{device.name} has no entry {text!r} (inputs and outputs: {known})")
    if len(named) > 1:
        places = ", ".join(map(str, named))
        raise ValueError(f"{device.name} has several entries {text!r}: {places}")
    return named[0]
