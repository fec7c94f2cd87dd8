from __future__ import annotations

import subprocess
import sys
from itertools import islice
from pathlib import Path
from random import Random

import pytest

from eap.codec.ethercat import FrameType
from tools.fuzz.__main__ import fuzz, list_targets, load_seeds, load_target, main
from tools.fuzz.mutator import mutations

INPUTS = 3000
SLOW = {"datagram": 1000, "esi": 100, "gateway": 1000, "sii": 1000}
"""Targets that build slaves or a gateway, or read as a master does, for each input."""


@pytest.fixture(scope="module")
def inputs() -> list[bytes]:
    return list(islice(mutations(load_seeds(), Random(7)), INPUTS))


@pytest.mark.parametrize("name", list_targets())
def test_target_lets_only_documented_exceptions_pass(name: str, inputs: list[bytes]) -> None:
    wanted = SLOW.get(name, INPUTS)
    count, find = fuzz(load_target(name), inputs[:wanted])
    assert find is None
    assert count == wanted


def test_seeds_hold_frames_of_every_type() -> None:
    types = {seed[1] >> 4 for seed in load_seeds() if len(seed) > 1}
    assert types >= {FrameType.DATAGRAM, FrameType.AMS, FrameType.PROCESS_DATA, FrameType.MAILBOX}


def test_undocumented_exception_is_found_with_its_octets() -> None:
    def fuzz_one(data: bytes) -> None:
        if data[:1] == b"\x07":
            raise KeyError(data[0])

    count, find = fuzz(fuzz_one, [b"a", b"", b"\x07\x08", b"b"])
    assert count == 2
    assert find is not None
    assert find.octets == b"\x07\x08"
    assert isinstance(find.error, KeyError)


def test_find_is_printed_and_fails(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def lookup(_cls: type, _data: bytes, _offset: int) -> None:
        raise KeyError("a decoder that documents nothing of the kind")

    monkeypatch.setattr("eap.codec.pd.PdHeader.decode", classmethod(lookup))
    assert main(["pd", "--seconds", "5"]) == 1
    printed = capsys.readouterr()
    assert "pd: found after" in printed.out
    assert "Traceback" in printed.err


def test_unknown_target_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["nothing"])
    assert "'nothing' is no target (one of ads, ams," in capsys.readouterr().err


def test_runs_as_a_program() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tools.fuzz", "ams", "mailbox", "--seconds", "0.1"],
        cwd=Path(__file__).parents[3],
        capture_output=True,
        text=True,
        check=True,
    )
    assert [line.partition(":")[0] for line in done.stdout.splitlines()] == ["ams", "mailbox"]
