"""Lines that never wait for who reads them."""

from __future__ import annotations

import os
import select

import pytest

from eap.supervisor.output import Output
from tests.support.limits import largest_file


@pytest.fixture
def pipe():
    reading, writing = os.pipe()
    with os.fdopen(reading), os.fdopen(writing, "w"):
        yield reading, writing


def read(fd: int) -> str:
    found = b""
    while select.select([fd], [], [], 0)[0]:
        found += os.read(fd, 65536)
    return found.decode()


def test_lines_go_where_somebody_reads(pipe):
    output = Output(pipe[1])
    for line in ("first", "second ä", "x" * 10_000):
        output.write(line)
    assert read(pipe[0]) == f"first\nsecond ä\n{'x' * 10_000}\n"
    assert output.left_out == 0


def test_what_nobody_takes_is_left_out_and_counted(pipe):
    output = Output(pipe[1])
    while not output.left_out:
        output.write("y" * 1000)
    output.write("nobody sees this")
    read(pipe[0])
    output.write("and this again")
    assert read(pipe[0]) == "(2 lines left out here, which nobody took)\nand this again\n"


def test_a_reader_that_has_gone_is_no_fault(pipe):
    output = Output(pipe[1])
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, pipe[0])  # closes the reading end, and leaves a descriptor to close
    os.close(null)
    output.write("nobody sees this")
    assert output.left_out == 1


def test_line_after_one_that_a_full_disk_cut_begins_anew(tmp_path):
    with (tmp_path / "log").open("wb") as file:
        output = Output(file.fileno())
        output.write("first")
        with largest_file(10):
            output.write("second is long")
            output.write("third")
        assert output.left_out == 2
        output.write("fourth")
        output.write("fifth")
    lines = (tmp_path / "log").read_text().splitlines()
    assert lines == [
        "first", "seco", "(2 lines left out here, which nobody took)", "fourth", "fifth",
    ]  # fmt: skip


def test_line_after_one_that_a_full_pipe_cut_begins_anew(pipe):
    output = Output(pipe[1])
    output.write("y" * 100_000)
    found = read(pipe[0])
    assert set(found) == {"y"}
    output.write("next")
    assert read(pipe[0]) == "\n(1 lines left out here, which nobody took)\nnext\n"
