"""Contenders of a measurement over a cable: a sender at one end, a receiver at the other."""

from __future__ import annotations

import importlib.util
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from tools.bench import machine, rawloop
from tools.bench.figures import BarKind
from tools.bench.network import Cable, Page
from tools.bench.stations import Shape


class Endpoint(NamedTuple):
    """A pair of roles that carries frames from one end to the other.

    Attributes:
        name: Its name in figures.
        send: Role of the sender; ``c.MODE`` is one of the raw loop in C.
        receive: Role of the receiver.
        package: Package of Python that it needs, and how it is called there.
        window: Whether the sender waits for its receiver; otherwise frames may be lost.
        kind: Its kind in charts.
        batch: Frames that a call of the raw loop in C moves; 0 for a receiver that never sleeps,
            also one of ours.
    """

    name: str
    send: str
    receive: str
    package: tuple[str, str] = ("", "")
    window: bool = True
    batch: int = 1
    kind: BarKind = BarKind.PEER

    def lacks(self) -> str:
        """Return what this machine lacks for it, or an empty text."""
        if self.send.startswith(f"{rawloop.PREFIX}."):
            return "" if rawloop.is_possible() else rawloop.NEEDS
        name, module = self.package
        return "" if not module or importlib.util.find_spec(module) else f"needs {name}"


def carry(
    link: Cable, way: Endpoint, shape: Shape, seconds: float, *, swap: bool
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Let *way* send for so long; return the answers of its sender and of its receiver.

    Publisher and subscriber have a core each, with *swap* the other one.  A run that fails is
    tried once more, for the machine may have stood still.

    Raises:
        RuntimeError: a process ended without an answer, or frames were lost within a window, so
            that the figures mean nothing.
    """
    try:
        return _carry(link, way, shape, seconds, swap=swap)
    except RuntimeError:
        return _carry(link, way, shape, seconds, swap=swap)


def _carry(
    link: Cable, way: Endpoint, shape: Shape, seconds: float, *, swap: bool
) -> tuple[dict[str, Any], dict[str, Any]]:
    sending, receiving = machine.cores() if not swap else machine.cores()[::-1]
    folder = Path(link.folder)
    for left in (folder / "page", *folder.glob("*.image")):
        left.unlink(missing_ok=True)
    page = Page(folder / "page")
    job = {
        "batch": way.batch,
        "window": way.window,
        "shape": msgspec.structs.asdict(shape),
        "folder": str(folder),
        "page": str(folder / "page"),
        "seconds": seconds,
        "address": link.address(0),
        "far": link.address(1),
    }
    with ExitStack() as stack:
        ends = []
        for side, name, cpu in ((1, way.receive, receiving), (0, way.send, sending)):
            more = job | {"interface": link.interface(side)}
            ends.append(stack.enter_context(rawloop.role(link, name, more, side=side, cpu=cpu)))
            if side:
                ends[0].answer()
        sent = ends[1].answer(seconds)
        page.words[Page.STOP] = 1
        received = ends[0].answer()
    arrived = received.get("received")  # a receiver of stamps does not count
    if way.window and arrived is not None and (arrived != sent["sent"] or received["lost"]):
        raise RuntimeError(f"{way.send}: {sent} but {received}")
    return sent, received
