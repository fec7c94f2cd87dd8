"""Which running stations belong to a plant, and what they are asked."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import pytest
from msgspec.structs import replace

from eap.config.bridge_sections import MqttSection
from eap.config.load import Plant
from eap.config.web_sections import MetricsSection, WebSection
from eap.errors import ControlError
from eap.ops.plant import StationPlan, link_to
from tests.support.fakeappliance import station
from tests.support.plantstub import PlantStub

pytestmark = pytest.mark.net

FILE = Path("line.yaml")
PLANT = Plant("line", (station("mixer"), station("oven")))


@pytest.fixture
def stack(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path / "run"))
    with ExitStack() as stack:
        yield stack


def test_all_appliances_of_the_plant(stack):
    PlantStub("line", [station("oven")], stack)
    PlantStub("hall", [station("mixer")], stack)
    with link_to(PLANT, FILE) as link:
        assert (link.stations, link.absent) == (("oven",), ("mixer",))


def test_a_blank_station_belongs_to_whoever_has_one_of_its_name(stack):
    PlantStub("mixer", [station("mixer")], stack, plant_file="")
    PlantStub("saw", [station("saw")], stack, plant_file="")
    with link_to(PLANT, FILE) as link:
        assert link.stations == ("mixer",)


def test_link_without_a_running_plant_is_refused(stack):
    PlantStub("hall", [station("mixer")], stack)
    with pytest.raises(ControlError, match=r"no station of plant line runs here.*run line\.yaml"):
        link_to(PLANT, FILE).__enter__()


def test_plan_refuses_another_duty_of_the_audit(stack):
    PlantStub("line", PLANT.stations, stack)
    with link_to(replace(PLANT, audit_required=True), FILE) as link:
        plan = link.plan(PLANT.stations[0])
    assert plan.refused == ["access: audit becomes required: restart the appliance"]


def test_link_passes_requests_to_the_station(stack):
    stub = PlantStub("line", PLANT.stations, stack)
    faster = replace(PLANT.stations[0], cycle_us=5000)
    with link_to(PLANT, FILE) as link:
        assert (link.export("mixer").spec, link.export("mixer").previous) == (
            station("mixer"),
            None,
        )
        plan = link.plan(faster)
        assert plan.differs
        assert [change.new for change in plan.changes] == ["5000"]
        assert link.apply(faster, "1").ok
        assert (link.export("mixer").cause, link.export("mixer").undone) == ("1", False)
        assert link.export("mixer").previous == station("mixer")
        assert stub.specs["mixer"] == faster
        assert link.rollback(station("mixer")).ok
        assert stub.specs["mixer"] == station("mixer")
        with pytest.raises(ControlError, match="has not that to go back to"):
            link.rollback(replace(station("oven"), cycle_us=7000))


@pytest.mark.parametrize("field", ["changes", "notes", "refused"])
def test_anything_is_a_difference(field):
    none = {"changes": [], "notes": [], "refused": []}
    assert not StationPlan("mixer", **none).differs
    assert StationPlan("mixer", **none | {field: ["x"]}).differs


def test_sections_that_an_appliance_runs_otherwise_are_named(stack):
    PlantStub("line", PLANT.stations, stack)
    before = replace(PLANT, web=WebSection(), bridges={"mqtt": MqttSection(broker="mqtt://b")})
    after = replace(
        PLANT, bridges={"mqtt": MqttSection(broker="mqtt://c")}, metrics=MetricsSection()
    )
    with link_to(PLANT, FILE) as link:
        assert link.sections_to_restart(after) == {}, "an older release does not say what it runs"
        for each in link._clients.values():
            each.info.sections = before.section_digests()
        assert link.sections_to_restart(before) == {}
        assert link.sections_to_restart(after) == {"line": ["metrics", "mqtt", "web"]}
