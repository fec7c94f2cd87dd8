from __future__ import annotations

from itertools import islice
from random import Random

from tools.fuzz.mutator import MAX_SIZE, mutations

SEEDS = [bytes(range(40)), b"\x15\x40", Random(0).randbytes(2000)]


def test_seeds_come_first_and_as_they_are() -> None:
    assert list(islice(mutations(SEEDS, Random(1)), 3)) == SEEDS


def test_same_seed_gives_the_same_octets() -> None:
    first, again, other = (list(islice(mutations(SEEDS, Random(n)), 200)) for n in (1, 1, 2))
    assert first == again
    assert first != other


def test_octets_are_damaged_in_many_ways_and_never_too_long() -> None:
    found = list(islice(mutations(SEEDS, Random(1)), 2000))
    assert max(map(len, found)) == MAX_SIZE
    assert min(map(len, found)) == 0
    assert len(set(found)) > 1500
