"""Completion of names by the shell, as the scripts of click ask for it."""

from __future__ import annotations

import pytest
from click.shell_completion import ShellComplete

from eap.cli import completion
from eap.cli.group import main
from eap.config.new_plant import Shape, plant_text
from eap.errors import ImageError
from eap.net.image_file import create_image
from eap.ops.plant import load_or_raise
from eap.pd.layout import plan_layout
from eap.runtime.folder import ApplianceFolder
from eap.supervisor.process import make_info

BUS = """\
      - {name: bus0, kind: bus, interface: "udp://127.0.1.9", net_id: 127.0.1.1.3.1}
    frames:
      - {name: to-next"""


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plant")
    text = plant_text("hall", 2, Shape.RING).replace("    frames:\n      - {name: to-next", BUS, 1)
    (folder / "hall.yaml").write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EAP_RUNTIME_DIR", str(folder / "run"))
        stations = load_or_raise(folder / "hall.yaml").stations
        with ApplianceFolder.claim("hall") as opened:
            opened.write_info(make_info("hall", "hall.yaml", stations))
            for station in stations:
                create_image(opened.image(station.name), plan_layout(station)).close()
            yield


def offered(*words: str) -> list[str]:
    *before, incomplete = words
    found = ShellComplete(main, {}, "eapctl", "_EAPCTL_COMPLETE").get_completions(
        before, incomplete
    )
    return [each.value for each in found]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("pd", "watch", ""), ["station-01", "station-02"]),
        (("pd", "watch", "station-02", "t"), ["temperature", "ticks", "to-next.FrameCtrl"]),
        (("pd", "watch", "station-01", "ticks", "run"), ["running"]),
        (("pd", "watch", "station-01/ti"), ["station-01/ticks"]),
        (("pd", "set", "station-01", "setp"), ["setpoint"]),
        (("pd", "watch", "other", ""), []),
        (("pd", "list", "--plant", "h"), ["hall"]),
        (("pd", "list", "--station", "x"), []),
        (("bus", "scan", ""), ["station-01/bus0"]),
        (("state", "station-01/"), ["station-01/bus0", "station-01/eap0", "station-01/router"]),
        (("routes", "list", "station-02"), ["station-02"]),
    ],
)
def test_shell_is_offered_what_runs(plant, words, expected):
    assert offered(*words) == expected


def test_image_that_cannot_be_read_offers_nothing(plant, monkeypatch):
    def fail(station: str = "") -> None:
        raise ImageError("it is being replaced")
        yield

    monkeypatch.setattr(completion, "_layouts", fail)
    assert offered("bus", "scan", "") == []
    assert offered("pd", "watch", "station-01", "") == []


def test_nothing_is_offered_where_nothing_runs(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path))
    assert offered("pd", "watch", "") == []
