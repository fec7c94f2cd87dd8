"""One station beside the loop in C: its plant, its frame, its figures, and the program."""

from __future__ import annotations

from pathlib import Path

import pytest

from eap.codec.pd import iter_pds
from eap.runtime.plantfile import load_plant
from tools.bench import rawloop
from tools.bench.figures import Decision
from tools.bench.onestation import SIZE, figures_of, frame, plant
from tools.bench.stations import ETHERNET_HEADER, PUBLISHER


def test_plant_of_one_station_is_a_plant(tmp_path: Path) -> None:
    path = tmp_path / "one.yaml"
    path.write_bytes(plant("lo"))
    assert not load_plant(path).findings


def test_frame_has_one_pd() -> None:
    ((header, payload),) = iter_pds(frame(PUBLISHER)[ETHERNET_HEADER:])
    assert (header.pd_id, bytes(payload)) == (1, bytes(SIZE))


def test_share_of_a_core_is_compared_by_round() -> None:
    pairs = [({"cpu": 0.03, "lost": 1, "received": 9}, {"cpu": 0.01}),
             ({"cpu": 0.02, "lost": 0, "received": 9}, {"cpu": 0.02})]  # fmt: skip
    share, lost = figures_of(pairs)
    assert (share.value, share.decision) == (2.0, Decision.MISSED)
    assert share.measured == "2.00 (2.5 to 1.5 %)"
    assert lost.measured == "1 of 18"


@pytest.mark.skipif(not rawloop.is_possible(), reason="needs a C compiler")
def test_raw_loop_compiles_without_warnings(tmp_path: Path) -> None:
    program = rawloop.build(tmp_path)
    assert program.stat().st_mode & 0o100
    assert rawloop.build(tmp_path) == program
