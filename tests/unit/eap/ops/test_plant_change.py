"""A plant changes station by station."""

from __future__ import annotations

from contextlib import ExitStack

import pytest
from msgspec.structs import replace

from eap.ams.spec import AccessRule
from eap.config.load import Plant
from eap.config.new_plant import Shape, plant_text
from eap.errors import ConfigError
from eap.ops.plant import (
    apply_steps,
    choose,
    link_to,
    load_or_raise,
    plan_all,
    roll_back,
    steps_to,
)
from eap.pd.spec import StationSpec
from tests.support.plantstub import PlantStub

pytestmark = pytest.mark.net

NAMES = ["station-01", "station-02", "station-03"]


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "ring.yaml"
    path.write_text(plant_text("ring", 3, Shape.RING))
    return path


@pytest.fixture
def plant(file) -> Plant:
    return load_or_raise(file)


@pytest.fixture
def stub(plant, tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path / "run"))
    with ExitStack() as stack:
        yield PlantStub("ring", plant.stations, stack)


@pytest.fixture
def link(stub, plant, file):
    with link_to(plant, file) as link:
        yield link


def changed(plant: Plant, name: str) -> dict[str, StationSpec]:
    """Return what is wanted when one station sends a variable less, in a new version."""
    wanted = {}
    for spec in plant.stations:
        frames, subscriptions = spec.frames, spec.subscriptions
        if spec.name == name:
            pd = replace(frames[0].pds[0], version=2, variables=("ticks", "running"))
            frames = (replace(frames[0], pds=(pd,)),)
        elif subscriptions[0].publisher == _publisher(plant, name):
            names = ("previous.ticks", "previous.running")
            subscriptions = (replace(subscriptions[0], version=2, variables=names),)
        wanted[spec.name] = replace(spec, frames=frames, subscriptions=subscriptions)
    return wanted


def _publisher(plant: Plant, name: str) -> str:
    return next(str(s.ports[0].net_id) for s in plant.stations if s.name == name)


def test_findings_of_the_file(tmp_path):
    (tmp_path / "bad.yaml").write_text("plant: bad")
    with pytest.raises(ConfigError, match="stations"):
        load_or_raise(tmp_path / "bad.yaml")


def test_stations_are_chosen(plant, link):
    assert list(choose(plant, link, ())) == NAMES
    assert list(choose(plant, link, NAMES[1:2])) == NAMES[1:2]
    with pytest.raises(ConfigError, match="has no station 'station-1', did you mean station-01"):
        choose(plant, link, ["station-1"])
    more = Plant("ring", (*plant.stations, replace(plant.stations[0], name="spare")))
    assert list(choose(more, link, ())) == NAMES
    with pytest.raises(ConfigError, match="spare does not run here; of its plant run station-01,"):
        choose(more, link, ["spare"])


def test_plan_of_the_same_plant_has_no_steps(plant, link):
    wanted = choose(plant, link, ())
    assert not any(each.differs for each in plan_all(link, wanted))
    assert steps_to(link, wanted) == []


def test_new_layout_is_taken_before_it_is_sent(plant, link, stub):
    wanted = changed(plant, "station-01")
    done = list(apply_steps(link, steps_to(link, wanted)))
    assert [each.station for each in done] == ["station-02", "station-01", "station-02"]
    assert all(each.outcome.ok for each in done)
    assert stub.specs == wanted
    assert stub.taken[0].subscriptions[0].alternates
    back = list(roll_back(link, NAMES))
    assert [each.station for each in back] == ["station-02", "station-01", "station-02"]
    assert [method for method, _ in stub.stub.requests if method in {"apply", "rollback"}] == [
        *["apply"] * 3,
        *["rollback"] * 3,
    ]
    assert stub.specs == {spec.name: spec for spec in plant.stations}
    list(roll_back(link, NAMES))
    assert stub.specs == wanted


def test_every_station_changes_what_it_sends(plant, link, stub):
    wanted = {
        name: replace(
            changed(plant, name)[name],
            subscriptions=changed(plant, other)[name].subscriptions,
        )
        for name, other in zip(NAMES, [NAMES[-1], *NAMES], strict=False)
    }
    order = steps_to(link, wanted)
    assert len(order) > 4
    list(apply_steps(link, order))
    assert stub.specs == wanted
    list(roll_back(link, NAMES))
    assert stub.specs == {spec.name: spec for spec in plant.stations}


def test_refusal_ends_it(plant, link, stub):
    wanted = {spec.name: replace(spec, cycle_us=20_000) for spec in plant.stations}
    stub.refuses = lambda spec: spec.name == "station-02"
    done = list(apply_steps(link, steps_to(link, wanted)))
    assert [(each.station, each.outcome.ok) for each in done] == [
        ("station-01", True),
        ("station-02", False),
    ]
    assert done[1].outcome.refused == ["not today"]
    done = list(apply_steps(link, steps_to(link, wanted), keep_going=True))
    assert [(each.station, each.outcome.ok) for each in done] == [
        ("station-02", False),
        ("station-03", True),
    ]


def test_refused_request_is_not_repeated(plant, link, stub):
    stub.refuses = lambda spec: spec.name == "station-02"
    order = steps_to(link, changed(plant, "station-01"))
    done = list(apply_steps(link, order, keep_going=True))
    assert [each.station for each in done] == ["station-02", "station-01"]


def test_interrupted_change_is_finished(plant, link, stub):
    wanted = changed(plant, "station-01")
    half = iter(apply_steps(link, steps_to(link, wanted)))
    next(half)
    assert stub.specs["station-02"].subscriptions[0].alternates
    list(apply_steps(link, steps_to(link, wanted)))
    assert stub.specs == wanted


@pytest.mark.parametrize("steps_done", [1, 2, 3])
def test_interrupted_change_is_undone(plant, link, stub, steps_done):
    half = iter(apply_steps(link, steps_to(link, changed(plant, "station-01"))))
    for _ in range(steps_done):
        next(half)
    list(roll_back(link, NAMES))
    assert stub.specs == {spec.name: spec for spec in plant.stations}
    list(roll_back(link, NAMES))


@pytest.mark.parametrize("steps_done", [1, 2, 3])
def test_rollback_undoes_an_interrupted_change_and_its_completion(plant, link, stub, steps_done):
    wanted = changed(plant, "station-01")
    half = iter(apply_steps(link, steps_to(link, wanted)))
    for _ in range(steps_done):
        next(half)
    list(apply_steps(link, steps_to(link, wanted)))
    assert stub.specs == wanted
    list(roll_back(link, NAMES))
    assert stub.specs == {spec.name: spec for spec in plant.stations}


def test_only_the_last_change_is_taken_back(plant, link, stub):
    slower = {spec.name: replace(spec, cycle_us=20_000) for spec in plant.stations}
    list(apply_steps(link, steps_to(link, slower)))
    wanted = {
        name: replace(spec, cycle_us=20_000) for name, spec in changed(plant, "station-01").items()
    }
    list(apply_steps(link, steps_to(link, wanted)))
    for now in (slower, wanted, slower):
        list(roll_back(link, NAMES))
        assert stub.specs == now


@pytest.mark.parametrize("steps_done", [1, 2, 3])
def test_interrupted_rollback_is_continued_or_undone(plant, link, stub, steps_done):
    before = {spec.name: spec for spec in plant.stations}
    wanted = changed(plant, "station-01")
    list(apply_steps(link, steps_to(link, wanted)))
    half = iter(roll_back(link, NAMES))
    for _ in range(steps_done):
        next(half)
    if steps_done < 3:
        list(roll_back(link, NAMES))
    assert stub.specs == before
    half = iter(roll_back(link, NAMES))
    for _ in range(steps_done):
        next(half)
    list(apply_steps(link, steps_to(link, wanted)))
    assert stub.specs == wanted
    list(roll_back(link, NAMES))
    assert stub.specs == before


def test_nothing_to_go_back_to(link):
    assert list(roll_back(link, NAMES)) == []


@pytest.fixture
def ruled(plant):
    """Return the plant with one more access rule at the first station."""
    first, rule = NAMES[0], AccessRule("engineers")
    told = replace(plant.routing[first], access=(rule,))
    return replace(plant, routing={**plant.routing, first: told})


def test_routers_are_configured_last_and_rolled_back(ruled, stub, file):
    with link_to(ruled, file) as link:
        wanted = changed(ruled, "station-01")
        notes = [each.notes for each in plan_all(link, wanted)]
        assert notes == [["access rule engineers: added"], [], []]
        done = list(apply_steps(link, steps_to(link, wanted), routed=NAMES))
        assert (done[-1].station, done[-1].why) == (NAMES[0], "(access rule engineers: added)")
        assert stub.told == {NAMES[0]: ["engineers"]}
        back = list(roll_back(link, NAMES))
        assert [each.station for each in back][-1] == NAMES[0]
        assert stub.told == {NAMES[0]: []}
        assert stub.specs == {spec.name: spec for spec in ruled.stations}
        list(roll_back(link, NAMES))
        assert stub.told == {NAMES[0]: ["again"]}
        assert stub.specs == wanted


def test_a_change_of_a_router_alone_is_taken_back_alone(ruled, stub, file):
    with link_to(ruled, file) as link:
        wanted = changed(ruled, "station-01")
        list(apply_steps(link, steps_to(link, wanted)))
        assert stub.told == {}
        (done,) = apply_steps(link, steps_to(link, wanted), routed=NAMES)
        assert done.outcome.ok
        (back,) = roll_back(link, NAMES)
        assert back.station == NAMES[0]
        assert stub.told == {NAMES[0]: []}
        assert stub.specs == wanted


def test_router_is_not_configured_when_a_station_refused(ruled, stub, file):
    stub.refuses = lambda spec: spec.name == NAMES[1]
    with link_to(ruled, file) as link:
        order = steps_to(link, changed(ruled, "station-01"))
        list(apply_steps(link, order, routed=NAMES))
        assert stub.told == {}
        list(apply_steps(link, order, keep_going=True, routed=NAMES))
        assert stub.told == {NAMES[0]: ["engineers"]}
