"""Sources that services plays into the images."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from contextlib import suppress

import msgspec
import pytest

from eap.codec import datatypes
from eap.errors import WriterConflictError
from eap.pd.spec import CsvSource, HostSource, Measure, Writer
from eap.services.device.sources import SourcePlayer, fit, play_sources
from tests.support.eventually import elapse, eventually, settle
from tests.unit.eap.conftest import left


@pytest.mark.parametrize(
    ("number", "kind", "fitted"),
    [(3.6, "USINT", 4), (300, "USINT", 255), (-1, "UINT", 0), (1.5, "REAL", 1.5), (7, "LREAL", 7)],
)
def test_a_number_is_fitted_to_its_type(number, kind, fitted):
    assert fit(number, datatypes.parse(kind)) == fitted


def play(image, *sources, seconds: float = 0.2) -> None:
    async def run():
        async with asyncio.timeout(seconds):
            await play_sources(msgspec.structs.replace(left(), sources=sources), image)

    with suppress(TimeoutError):
        asyncio.run(run())


def test_a_measurement_arrives(images):
    play(images["left"], HostSource("load", Measure.PROCESSES, period_ms=10))
    assert images["left"].image.read("load") > 0


def test_a_column_is_replayed_from_the_start_again(images, tmp_path):
    (tmp_path / "data.csv").write_text("time,load\n0,17\n1,18\n")
    image = images["left"]
    seen = set()

    async def run():
        source = CsvSource("load", str(tmp_path / "data.csv"), "load", period_ms=10)
        station = msgspec.structs.replace(left(), sources=(source,))
        async with asyncio.timeout(5), asyncio.TaskGroup() as group:
            task = group.create_task(play_sources(station, image))

            def has_seen_both() -> bool:
                seen.add(image.image.read("load"))
                return seen - {0} == {17, 18}

            await eventually(has_seen_both)
            task.cancel()

    asyncio.run(run())


def test_unreadable_source_keeps_its_value_and_is_logged_once(images, tmp_path, caplog):
    (tmp_path / "data.csv").write_text("load\nmany\n")
    play(
        images["left"],
        HostSource("load", Measure.RX_OCTETS, "nosuch0", period_ms=10),
        CsvSource("load", str(tmp_path / "data.csv"), "load", period_ms=10),
        CsvSource("load", str(tmp_path / "gone.csv"), "load"),
    )
    assert images["left"].image.read("load") == 0
    assert sorted(record.getMessage().split()[0] for record in caplog.records) == ["left/load"] * 3


def test_without_sources_nothing_is_claimed(images):
    play(images["left"])
    code = (
        "import sys\n"
        "from pathlib import Path\n"
        "from eap.net.image_file import open_image\n"
        "from eap.pd.spec import Writer\n"
        "file = open_image(Path(sys.argv[1]))\n"
        "file.acquire_writer(Writer.SERVICES)\n"
        "print('holding', flush=True)\n"
        "sys.stdin.read()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(images["left"].file.path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as other:
        assert other.stdout.readline() == b"holding\n"
        with pytest.raises(WriterConflictError, match=str(other.pid)):
            play(images["left"], HostSource("load", Measure.LOAD1))
        other.stdin.close()


def test_other_sources_take_over_and_the_same_ones_go_on(images, tmp_path):
    for name, numbers in (("a", range(1, 200)), ("b", [7])):
        lines = "\n".join(["load", *map(str, numbers)])
        (tmp_path / f"{name}.csv").write_text(lines + "\n")

    def playing(name: str, **more):
        source = CsvSource("load", str(tmp_path / f"{name}.csv"), "load", period_ms=10)
        return msgspec.structs.replace(left(), sources=(source,), **more)

    image = images["left"]

    async def wait_for(matches):
        await eventually(lambda: matches(image.image.read("load")))

    async def run():
        player = SourcePlayer(playing("a"), image)
        async with asyncio.TaskGroup() as group:
            task = group.create_task(player.serve())
            await wait_for(lambda value: value >= 10)
            player.change(playing("a", cycle_us=20_000))
            seen = []
            await wait_for(lambda value: seen.append(value) or value >= 12)
            assert min(seen) >= 10  # not from the start again
            player.change(playing("b"))
            await wait_for(lambda value: value == 7)
            player.change(msgspec.structs.replace(left(), sources=()))
            await settle()
            with image.image.writing(Writer.SERVICES):
                image.image.write("load", 0)
            await elapse(1)
            assert image.image.read("load") == 0
            task.cancel()

    asyncio.run(run())
