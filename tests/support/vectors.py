"""Golden octets of ``tests/vectors``: loading, and the EtherCAT frames within."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import NamedTuple

import yaml

FOLDER = Path(__file__).parents[1] / "vectors"


class Vector(NamedTuple):
    """Octets of one *layer* with what they mean; *error* instead of fields for broken ones."""

    name: str
    layer: str
    octets: bytes
    fields: dict
    error: str

    @property
    def frame(self) -> bytes:
        """The EtherCAT frame of a vector of layer ``ethernet`` or ``frame``, with its padding."""
        return self.octets if self.layer == "frame" else _frame(self.octets)


@cache
def load(stem: str) -> tuple[Vector, ...]:
    """All vectors of the file ``STEM.yaml``."""
    content = read_yaml(stem)
    assert content["source"]
    return tuple(
        Vector(
            f"{stem}/{item['name']}",
            item.get("layer", content["layer"]),
            bytes.fromhex(item["octets"]),
            item.get("fields", {}),
            item.get("error", ""),
        )
        for item in content["vectors"]
    )


def read_yaml(stem: str) -> dict:
    """Return the content of ``STEM.yaml``; the loader in Python takes seconds for the longest."""
    return yaml.load((FOLDER / f"{stem}.yaml").read_text(), Loader=yaml.CSafeLoader)


def load_all(*layers: str) -> list[Vector]:
    """The vectors of *layers* of all files."""
    stems = sorted(path.stem for path in FOLDER.glob("*.yaml") if path.stem != "type1_datagrams")
    return [vector for stem in stems for vector in load(stem) if vector.layer in layers]


def load_datagrams() -> list[tuple[str, dict]]:
    """The datagrams of ``type1_datagrams.yaml``, which come as fields."""
    content = read_yaml("type1_datagrams")
    return [
        (f"{Path(name).stem}#{item.pop('frame')}", item)
        for name, items in content["files"].items()
        for item in items
    ]


def _frame(octets: bytes) -> bytes:
    start = 16 if octets[12:14] == b"\x81\x00" else 12
    if octets[start : start + 2] == b"\x88\xa4":
        return octets[start + 2 :]
    assert octets[start : start + 2] == b"\x08\x00"
    assert octets[start + 2] == 0x45, "no options in these IP headers"
    return octets[start + 30 :]


def load_message(name: str) -> bytes:
    """The data of one mailbox message of ``type5_mailbox.yaml``, behind its headers."""
    (vector,) = [item for item in load("type5_mailbox") if item.name.endswith(name)]
    return bytes.fromhex(vector.fields["mailbox"]["data"])
