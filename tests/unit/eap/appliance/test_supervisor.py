"""The supervisor's start and its refusals; tests/integration has the rest of its life."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from eap.appliance.handover import EngineOptions
from eap.appliance.runtime import ApplianceFolder, find_appliances
from eap.appliance.sockets import SharedSockets
from eap.appliance.supervisor import Supervisor, make_info, run
from eap.errors import ConfigError

DEMO = Path(__file__).parents[4] / "config" / "demo.yaml"


@pytest.fixture(autouse=True)
def root(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path / "run"))
    return tmp_path / "run"


def test_a_wrong_plant_is_refused_with_all_its_findings(tmp_path, root):
    plant = tmp_path / "plant.yaml"
    plant.write_text("plant: x\nstation: []\ncolour: red\n")
    with pytest.raises(ConfigError) as caught:
        run(plant)
    assert len(str(caught.value).splitlines()) > 1
    assert f"{plant}:2" in str(caught.value)
    assert not root.exists()


def test_an_unknown_station_is_refused_with_the_near_one(root):
    with pytest.raises(ConfigError, match="did you mean island-01"):
        run(DEMO, ["island-1"])
    with pytest.raises(ConfigError, match="it has island-01, island-02, island-03"):
        run(DEMO, ["x"])
    assert not root.exists()


def test_info_names_this_process(stations):
    info = make_info("demo", "/demo.yaml", stations)
    assert (info.supervisor, info.stations) == (os.getpid(), ["left", "right"])
    assert info.started_at.endswith("+00:00")


@pytest.mark.net
def test_a_child_that_cannot_start_ends_all_with_its_exit_code(stations, capfd):
    options = EngineOptions(realtime=False)
    with ApplianceFolder.claim("demo") as folder:
        with SharedSockets(stations, folder.control_socket) as sockets:
            folder.image("left").mkdir()  # no image can be made here
            info = make_info("demo", "demo.yaml", stations)
            assert Supervisor(info, stations, folder, sockets, options=options).run() == 2
        engine, services = folder.read_info().engine.pid, folder.read_info().services.pid
    out, err = capfd.readouterr()
    assert out == ""
    assert err.startswith("engine: ")
    assert len(err.splitlines()) == 1
    assert not Path(f"/proc/{engine}").exists()
    assert not Path(f"/proc/{services}").exists()
    assert find_appliances() == []
