"""Damage good octets in every run the same way: the engine where atheris is not installed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from random import Random

MAX_SIZE = 2048
"""Octets of the longest input: a little more than the largest EtherCAT frame."""
_EDGES = (b"\x00", b"\xff", b"\x7f\x80", b"\xff\x07", b"\xff\xff", b"\x00\x80", b"\xff\xff\xff\xff")


def mutations(seeds: Sequence[bytes], dice: Random) -> Iterator[bytes]:
    """Yield every seed as it is, then damaged ones without end."""
    yield from seeds
    while True:
        octets = bytearray(dice.choice(seeds))
        for _ in range(dice.choice((1, 1, 2, 4, 16))):
            dice.choice(_DAMAGES)(octets, dice)
        if dice.random() < 0.1:
            octets += dice.choice(seeds)
        yield bytes(octets[:MAX_SIZE])


def _at(octets: bytearray, dice: Random) -> int:
    # Twice as likely near the start, where the headers are.
    end = len(octets) if dice.random() < 0.5 else min(len(octets), 24)
    return dice.randint(0, end)


def _flip(octets: bytearray, dice: Random) -> None:
    at = _at(octets, dice)
    if at < len(octets):
        octets[at] ^= 1 << dice.randrange(8)


def _put_edge(octets: bytearray, dice: Random) -> None:
    at, edge = _at(octets, dice), dice.choice(_EDGES)
    octets[at : at + len(edge)] = edge


def _truncate(octets: bytearray, dice: Random) -> None:
    del octets[_at(octets, dice) :]


def _remove(octets: bytearray, dice: Random) -> None:
    at = _at(octets, dice)
    del octets[at : at + dice.randint(1, 8)]


def _insert(octets: bytearray, dice: Random) -> None:
    at = _at(octets, dice)
    octets[at:at] = dice.randbytes(dice.randint(1, 8))


def _repeat(octets: bytearray, dice: Random) -> None:
    at = _at(octets, dice)
    octets[at:at] = octets[at : at + dice.randint(1, 32)]


_DAMAGES: tuple[Callable[[bytearray, Random], None], ...] = (
    _flip,
    _flip,
    _put_edge,
    _truncate,
    _remove,
    _insert,
    _repeat,
)
