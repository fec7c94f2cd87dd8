"""Stations that can be planned, applied and rolled back, without anything that runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

import msgspec

from eap.device.rollout import without_alternates
from eap.errors import ControlError
from eap.ids import decode_value
from eap.pd.spec import StationSpec
from tests.support.controlstub import ControlStub


class PlantStub:
    """The specifications of a plant's stations, behind a control socket.

    Attributes:
        specs: What each station runs.
        previous: What each ran before the last change.
        causes: Which change that was.
        undone: Where it was taken back.
        unable: Stations that say so when they are planned.
        refuses: Tells whether a station refuses a specification when it is applied.
        taken: Everything that was applied, in order.
        told: What each router was told that was told anything, and not before: its rules' names.
        routing_causes: Which change of a router that was.
    """

    def __init__(self, plant: str, specs: Sequence[StationSpec], stack: ExitStack,
                 plant_file: str = "plant.yaml") -> None:  # fmt: skip
        self.specs = {spec.name: spec for spec in specs}
        self.previous: dict[str, StationSpec] = {}
        self.causes: dict[str, str] = {}
        self.undone: set[str] = set()
        self.unable: set[str] = set()
        self.refuses: Callable[[StationSpec], bool] = lambda _: False
        self.taken: list[StationSpec] = []
        self.told: dict[str, list[str]] = {}
        self.routing_causes: dict[str, str] = {}
        methods = {
            each.__name__: each
            for each in (
                self.export, self.plan, self.apply, self.rollback,
                self.routing_export, self.routing_plan, self.routing_apply, self.routing_rollback,
            )
        }  # fmt: skip
        self.stub = ControlStub(plant, list(self.specs), methods, stack, plant_file=plant_file)

    def export(self, params: dict[str, Any]) -> Any:
        name = params["station"]
        return {
            "spec": self.specs[name],
            "previous": self.previous.get(name),
            "cause": self.causes.get(name, ""),
            "undone": name in self.undone,
        }

    def plan(self, params: dict[str, Any]) -> Any:
        name, spec = self._asked(params)
        refused = ["port eap0 would be new"] if name in self.unable else []
        changes = [] if refused else self._changes(name, spec)
        return {"changes": changes, "station": [], "refused": refused}

    def apply(self, params: dict[str, Any]) -> Any:
        name, spec = self._asked(params)
        before = self.specs[name]
        answer = self._take(name, spec)
        if answer["ok"] and (params["cause"] != self.causes.get(name) or name in self.undone):
            self.previous[name] = without_alternates(before)
            self.causes[name] = params["cause"]
            self.undone.discard(name)
        return answer

    def rollback(self, params: dict[str, Any]) -> Any:
        name, spec = self._asked(params)
        before, after = (without_alternates(each) for each in (self.specs[name], spec))
        if after != before and after != self.previous.get(name):
            raise ControlError(f"station {name} has not that to go back to")
        answer = self._take(name, spec)
        if answer["ok"] and after != before:
            self.previous[name] = before
            self.undone ^= {name}
        return answer

    def routing_export(self, params: dict[str, Any]) -> Any:
        name = params["station"]
        if name not in self.told:
            return {"routing": {}}
        cause = self.routing_causes[name]
        undone = not self.told[name]
        return {"routing": {}, "previous": {}, "cause": cause, "undone": undone}

    def routing_plan(self, params: dict[str, Any]) -> Any:
        rules = [rule["name"] for rule in params["routing"].get("access", [])]
        is_same = self.told.get(params["station"], []) == rules
        changes = [] if is_same else [f"access rule {rule}: added" for rule in rules]
        return {"changes": changes, "refused": []}

    def routing_apply(self, params: dict[str, Any]) -> Any:
        answer = self.routing_plan(params)
        name = params["station"]
        self.told[name] = [rule["name"] for rule in params["routing"].get("access", [])]
        self.routing_causes[name] = params["cause"]
        return answer

    def routing_rollback(self, params: dict[str, Any]) -> Any:
        name = params["station"]
        self.told[name] = [] if self.told[name] else ["again"]
        return {"changes": ["access rules: changed"], "refused": []}

    def _asked(self, params: dict[str, Any]) -> tuple[str, StationSpec]:
        return params["station"], msgspec.convert(
            params["spec"], StationSpec, dec_hook=decode_value
        )

    def _take(self, name: str, spec: StationSpec) -> Any:
        is_ok = not self.refuses(spec)
        results = [
            change | {"ok": is_ok, "reason": "" if is_ok else "not today"}
            for change in self._changes(name, spec)
        ]
        if is_ok:
            self.specs[name] = spec
            self.taken.append(spec)
        refused = [] if is_ok else ["not today"]
        return {"ok": is_ok, "results": results, "station": [], "refused": refused}

    def _changes(self, name: str, spec: StationSpec) -> list[dict[str, Any]]:
        """Compare the cycle times only: one of them is enough for a test to see."""
        old, new = self.specs[name].cycle_us, spec.cycle_us
        row = {"port": "eap0", "index": 0xF800, "subindex": 8, "change": "changed",
               "name": "Configured objects: Device cycle time"}  # fmt: skip
        return [] if old == new else [row | {"old": str(old), "new": str(new), "unit": "us"}]
