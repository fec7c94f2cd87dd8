"""The image as a file: shared by processes, locked by its writers, slept on by its readers."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from msgspec.structs import replace

from eap.errors import EnvironmentalError, ImageError, TornReadError, WriterConflictError
from eap.net import image_file
from eap.net.image_file import ImageFile, StationImage, create_image, open_image
from eap.pd.layout import plan_layout
from eap.pd.spec import VariableSpec, Writer
from eap.pd.words import StationWord
from tests.support.cyclic import station, written
from tests.support.eventually import wait_until

pytestmark = pytest.mark.net

LAYOUT = plan_layout(station(variables=written("x:UINT")))
WIDER = plan_layout(station(variables=written("x:UINT", "y:UINT")))
PREAMBLE = """
import sys
from pathlib import Path
from eap.net.image_file import open_image
from eap.pd.spec import Writer
from eap.pd.words import StationWord
file = open_image(Path(sys.argv[1]))
words = file.image.words
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.image"


@pytest.fixture
def engine(path: Path) -> Iterator[ImageFile]:
    with create_image(path, LAYOUT) as file:
        yield file


def spawn(path: Path, script: str) -> subprocess.Popen[str]:
    """Start another process that has opened the image as *file*."""
    command = [sys.executable, "-c", PREAMBLE + script, str(path)]
    return subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=Path.cwd()
    )


def ended(process: subprocess.Popen[str]) -> str:
    output, _ = process.communicate(timeout=20)
    return output.strip()


def run_cycle(file: ImageFile) -> None:
    """Do to the words what an engine does in a cycle."""
    words = file.image.words
    words[StationWord.CYCLE] += 1
    words[StationWord.FUTEX] = words[StationWord.CYCLE] & 0xFFFFFFFF
    file.wake_waiters()


def test_an_engine_that_comes_back_finds_its_counters(path):
    with create_image(path, LAYOUT) as first:
        first.image.words[StationWord.CYCLE] = 42
    with create_image(path, LAYOUT) as second:
        assert second.image.words[StationWord.CYCLE] == 42
        assert second.generation == 1
        assert not second.retired


def test_a_new_layout_is_a_new_generation_and_retires_the_old_file(path, engine):
    engine.image.words[StationWord.CYCLE] = 42
    with create_image(path, WIDER) as wider:
        assert (wider.generation, wider.retired) == (2, False)
        assert wider.image.words[StationWord.CYCLE] == 42
        assert engine.retired
        with open_image(path) as again:
            assert again.image.layout == WIDER
    assert engine.image.read("x") == 0  # still mapped, still readable
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_the_new_file_is_there_before_the_old_one_says_so(path, engine, monkeypatch):
    seen = []

    def look(file: ImageFile) -> None:
        with open_image(path) as found:
            seen.append((file.retired, found.generation))

    monkeypatch.setattr(ImageFile, "wake_waiters", look)
    create_image(path, WIDER).close()
    assert seen == [(True, 2)]


def test_an_image_of_another_kind_is_replaced(path):
    path.write_bytes(b"no image at all")
    with create_image(path, LAYOUT) as file:
        assert file.generation == 1


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(EnvironmentalError, match=r"missing/a\.image: the process image cannot"):
        create_image(tmp_path / "missing" / "a.image", LAYOUT)


def test_a_failure_half_way_leaves_nothing_behind(path, monkeypatch):
    def full(descriptor: int, offset: int, size: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(EnvironmentalError, match="No space left"):
        create_image(path, LAYOUT)
    assert list(path.parent.iterdir()) == []


@pytest.mark.parametrize(
    ("octets", "message"),
    [(None, "no process image: No such file"), (b"", "empty"), (bytes(200), "magic is missing")],
)
def test_open_image_error_has_path_and_reason(path, octets, message):
    if octets is not None:
        path.write_bytes(octets)
    with pytest.raises(ImageError, match=message) as error:
        open_image(path)
    assert str(path) in str(error.value)


def test_two_processes_see_the_same_variables(path, engine):
    script = 'with file.image.writing(Writer.APPLICATION): file.image.write("x", 4711)'
    process = spawn(path, script)
    ended(process)
    assert process.returncode == 0
    assert engine.image.read("x") == 4711


def test_acquire_writer_conflict_names_holder(path, engine):
    process = spawn(
        path, 'file.acquire_writer(Writer.APPLICATION); print("mine", flush=True); input()'
    )
    assert process.stdout.readline() == "mine\n"
    engine.acquire_writer(Writer.ENGINE)  # another region has another writer
    with pytest.raises(WriterConflictError, match="the application variables") as error:
        engine.acquire_writer(Writer.APPLICATION)
    assert f"process {process.pid} (" in error.value.holder
    assert Path(sys.executable).name.rstrip("0123456789.") in error.value.holder
    process.kill()  # however it ends, the right to write ends with it
    ended(process)
    engine.acquire_writer(Writer.APPLICATION)


def test_a_writer_can_give_up_its_right(path, engine):
    engine.acquire_writer(Writer.APPLICATION)
    script = """
from eap.errors import WriterConflictError
for _ in range(2):
    try:
        file.acquire_writer(Writer.APPLICATION)
        print("mine", flush=True)
    except WriterConflictError as error:
        print(error.holder, flush=True)
    input()
"""
    process = spawn(path, script)
    assert f"process {os.getpid()} (" in process.stdout.readline()
    engine.release_writer(Writer.APPLICATION)
    process.stdin.write("\n")
    process.stdin.flush()
    assert process.stdout.readline() == "mine\n"
    process.stdin.write("\n")
    ended(process)


def test_close_releases_writer_while_views_exist(path, engine):
    first = open_image(path)
    first.acquire_writer(Writer.APPLICATION)
    image = first.image
    first.close()
    with open_image(path) as second:
        second.acquire_writer(Writer.APPLICATION)
    assert image.read("x") == 0


def test_a_lock_that_fails_for_another_reason_is_not_a_conflict(engine, monkeypatch):
    def no_locks(*_: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(image_file.fcntl, "fcntl", no_locks)
    with pytest.raises(OSError, match="No locks available"):
        engine.acquire_writer(Writer.APPLICATION)


def test_closing_twice_does_no_harm(path):
    file = create_image(path, LAYOUT)
    file.close()
    file.close()
    assert file.image.read("x") == 0


def test_a_holder_that_cannot_be_looked_at_is_still_named_by_its_number(path, engine, monkeypatch):
    process = spawn(
        path, 'file.acquire_writer(Writer.SERVICES); print("mine", flush=True); input()'
    )
    process.stdout.readline()

    def forbidden(self: Path) -> bytes:
        raise PermissionError

    monkeypatch.setattr(Path, "read_bytes", forbidden)
    with pytest.raises(WriterConflictError, match=rf"process {process.pid} \(unknown program\)"):
        engine.acquire_writer(Writer.SERVICES)
    process.communicate("\n", timeout=20)


def test_a_writer_that_was_killed_in_the_middle_is_named_and_its_successor_repairs(path, engine):
    script = """
with file.image.writing(Writer.APPLICATION):
    print("writing", flush=True)
    input()
"""
    process = spawn(path, script)
    assert process.stdout.readline() == "writing\n"
    process.send_signal(signal.SIGKILL)
    ended(process)
    with pytest.raises(TornReadError, match="the application stopped"):
        engine.image.read("x")
    with engine.image.writing(Writer.APPLICATION):
        engine.image.write("x", 1)
    assert engine.image.read("x") == 1


def test_waiting_ends_with_the_next_cycle(path, engine):
    engine.image.words[StationWord.CYCLE] = 7
    engine.image.words[StationWord.FUTEX] = 7
    script = """
print("waiting", flush=True)
print(file.wait_cycle(7, 15.0), words[StationWord.CYCLE])
"""
    process = spawn(path, script)
    process.stdout.readline()
    wait_until(lambda: engine.image.words[StationWord.WAITERS] == 7)
    wait_until(lambda: "S (sleeping)" in Path(f"/proc/{process.pid}/status").read_text())
    run_cycle(engine)
    assert ended(process) == "True 8"


def test_no_wake_up_is_lost_in_many_cycles(path, engine):
    script = """
cycle = 0
print("waiting", flush=True)
while cycle < 300:
    assert file.wait_cycle(cycle, 10.0)
    cycle = words[StationWord.CYCLE]
print("all")
"""
    process = spawn(path, script)
    process.stdout.readline()
    began = time.monotonic()
    for _ in range(300):
        time.sleep(0.0005)
        run_cycle(engine)
    assert ended(process) == "all"
    assert time.monotonic() - began < 8


def test_waiting_for_a_cycle_that_has_passed_returns_at_once(engine):
    run_cycle(engine)
    assert engine.wait_cycle(0, 0.0)


@pytest.mark.parametrize("between_the_words", [False, True])
def test_wait_cycle_times_out_without_engine(engine, between_the_words):
    """Also one that was killed after it moved the counter and before it moved the futex."""
    engine.image.words[StationWord.CYCLE] = 5
    engine.image.words[StationWord.FUTEX] = 4 if between_the_words else 5
    began, cpu = time.monotonic(), time.process_time()
    assert not engine.wait_cycle(5, 0.2)
    assert 0.19 < time.monotonic() - began < 5
    assert time.process_time() - cpu < 0.1, "it slept, it did not spin"


def test_signals_do_not_make_the_waiting_longer(path, engine):
    script = """
import signal, time
signal.signal(signal.SIGALRM, lambda *_: None)
signal.setitimer(signal.ITIMER_REAL, 0.02, 0.02)
began = time.monotonic()
print(file.wait_cycle(0, 0.3), 0.29 < time.monotonic() - began < 5)
"""
    assert ended(spawn(path, script)) == "False True"


def test_waiting_programs_are_woken_when_the_layout_changes(path, engine):
    engine.image.words[StationWord.WAITERS] = -1
    script = """
print("waiting", flush=True)
print(file.wait_cycle(0, 15.0), file.retired)
"""
    process = spawn(path, script)
    process.stdout.readline()
    wait_until(lambda: engine.image.words[StationWord.WAITERS] == 0)
    create_image(path, WIDER).close()
    assert ended(process) == "False True"


def test_a_reader_pauses_between_its_attempts(engine, monkeypatch):
    pauses = []
    monkeypatch.setattr(image_file._libc, "usleep", pauses.append)
    engine.image.words[StationWord.APPLICATION_SEQUENCE] = 1
    with pytest.raises(TornReadError):
        engine.image.read("x")
    assert set(pauses) == {100}


def test_defaults_reach_the_file(path):
    layout = plan_layout(station(variables=(VariableSpec("v", "REAL", default=2.5),)))
    create_image(path, layout).close()
    with open_image(path) as file:
        assert file.image.read_all() == {"v": 2.5}


@pytest.fixture
def image_path(files):
    return files["left"].path


@pytest.fixture
def station_image(image_path):
    station_image = StationImage(image_path)
    yield station_image
    station_image.close()


@pytest.fixture
def move(image_path, stations):
    """Give the station_image an image with a variable more, or fewer."""
    opened = []

    def move(count: int = 1, *, without: str = ""):
        spec = stations[0]
        kept = tuple(each for each in spec.variables if each.name != without)
        more = tuple(VariableSpec(f"more{n}", "UINT") for n in range(count))
        frames = () if without else spec.frames
        spec = replace(spec, variables=kept + more, frames=frames)
        opened.append(create_image(image_path, plan_layout(spec)))

    yield move
    for file in opened:
        file.close()


def test_missing_image(tmp_path):
    with pytest.raises(ImageError, match="no process image"):
        StationImage(tmp_path / "none.image")


def test_moves_to_the_newest_image(station_image, move):
    before = station_image.image
    assert station_image.image is before
    move()
    assert "more0" in station_image.image.slots
    assert station_image.file.generation == 2
    before.read("setpoint")  # what somebody still holds stays as it was


def test_station_image_error_when_newest_image_is_missing(station_image, move, image_path):
    move()
    image_path.unlink()
    with pytest.raises(ImageError, match="no process image"):
        _ = station_image.image


def test_right_to_write_moves_too(station_image, move, image_path):
    station_image.acquire_writer(Writer.SERVICES)
    move()
    assert "more0" in station_image.image.slots
    with open_image(image_path) as other:
        with pytest.raises(WriterConflictError):
            other.acquire_writer(Writer.SERVICES)
        station_image.release_writer(Writer.SERVICES)
        other.acquire_writer(Writer.SERVICES)
    move(2)
    assert "more1" in station_image.image.slots


def test_station_image_keeps_old_image_after_writer_conflict(station_image, move, image_path):
    station_image.acquire_writer(Writer.APPLICATION)
    move()
    with open_image(image_path) as other:
        other.acquire_writer(Writer.APPLICATION)
        with pytest.raises(WriterConflictError):
            _ = station_image.image
    assert "more0" in station_image.image.slots


def test_values_are_written_at_once_or_not_at_all(station_image):
    station_image.acquire_writer(Writer.APPLICATION)
    station_image.write(Writer.APPLICATION, {"running": True, "name": "x"})
    assert station_image.image.read("running") is True
    with pytest.raises(ValueError, match="not a value"):
        station_image.write(Writer.APPLICATION, {"running": False, "name": 1})
    with pytest.raises(ImageError, match="no variable 'gone'"):
        station_image.write(Writer.APPLICATION, {"running": False, "gone": 1})
    assert station_image.image.read("running") is True


def test_values_written_while_the_image_changes_are_in_the_new_one(
    station_image, move, monkeypatch
):
    station_image.acquire_writer(Writer.APPLICATION)
    writing = station_image.image.writing

    @contextmanager
    def write_late(writer):
        with writing(writer):
            yield
        move()  # the engine has copied what there was before

    monkeypatch.setattr(station_image.image, "writing", write_late)
    station_image.write(Writer.APPLICATION, {"running": True})
    assert "more0" in station_image.image.slots
    assert station_image.image.read("running") is True


def test_station_image_write_of_removed_variable_fails(station_image, move):
    station_image.acquire_writer(Writer.APPLICATION)
    move(without="running")
    with pytest.raises(ImageError, match="no variable 'running'"):
        station_image.write(Writer.APPLICATION, {"running": True})


def test_writer_for_one_write_leaves_the_place_to_others(station_image, image_path):
    station_image.write_once(Writer.APPLICATION, {"running": True})
    with open_image(image_path) as other:
        assert other.image.read("running") is True
        other.acquire_writer(Writer.APPLICATION)
        with pytest.raises(WriterConflictError):
            station_image.write_once(Writer.APPLICATION, {"running": False})
    with pytest.raises(ValueError, match="BOOL"):
        station_image.write_once(Writer.APPLICATION, {"running": 2})
    station_image.acquire_writer(Writer.APPLICATION)
