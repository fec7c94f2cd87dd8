from __future__ import annotations

import subprocess
import sys
from itertools import islice
from pathlib import Path
from random import Random

import pytest

from eap.codec.ethercat import FrameType
from tools.fuzz.__main__ import ROOT, fuzz, list_targets, load_seeds, load_target, main
from tools.fuzz.mutator import mutations

INPUTS = 3000
SLOW = {
    "datagram": 1000, "esi": 100, "gateway": 1000, "imports": 50, "plant_file": 50,
    "recording": 200, "sii": 1000,
}  # fmt: skip
"""Targets that build slaves, plants or a gateway, write files, or read as a master does."""


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


@pytest.fixture
def broken_decoder(monkeypatch: pytest.MonkeyPatch) -> None:
    def lookup(_cls: type, _data: bytes, _offset: int) -> None:
        raise KeyError("a decoder that documents nothing of the kind")

    monkeypatch.setattr("eap.codec.pd.PdHeader.decode", classmethod(lookup))


def test_find_is_printed_and_fails(
    broken_decoder: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["pd", "--seconds", "5", "--folder", str(tmp_path)]) == 1
    printed = capsys.readouterr()
    assert "pd: found after" in printed.out
    assert "Traceback" in printed.err


def test_find_is_kept_and_tried_first_in_the_next_run(
    broken_decoder: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    finds = tmp_path / "finds"
    assert main(["pd", "--seconds", "5", "--folder", str(finds)]) == 1
    (find,) = finds.glob("pd-*.bin")
    report = find.with_suffix(".txt").read_text()
    assert report.startswith("pd: found after")
    assert find.read_bytes().hex() in report
    assert 'File "tools/fuzz/targets/pd.py"' in report
    assert str(ROOT) not in report
    capsys.readouterr()
    assert main(["pd", "--seconds", "0", "--folder", str(finds)]) == 1
    assert "pd: found after 0 inputs" in capsys.readouterr().out


def test_targets_run_side_by_side_and_are_summed_up(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["ams", "pd", "--seconds", "0.1", "--jobs", "2", "--folder", str(tmp_path)]
    assert main(arguments) == 0
    lines = capsys.readouterr().out.splitlines()
    assert {line.partition(":")[0] for line in lines[:-1]} == {"ams", "pd"}
    assert lines[-1].startswith("2 targets, ")
    assert lines[-1].endswith(" inputs: 0 finds")


def test_unknown_target_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["nothing"])
    assert "'nothing' is no target (one of ads, ams," in capsys.readouterr().err


def test_runs_as_a_program() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tools.fuzz", "ams", "mailbox", "--seconds=0.1", "--jobs=1"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    names = [line.partition(":")[0] for line in done.stdout.splitlines()]
    assert names[:-1] == ["ams", "mailbox"]
