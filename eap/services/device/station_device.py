"""The EAP device of a station as services serve it: its dictionaries, states and changes.

Rule 1: each change is a job; jobs run one after the other and to their ends.
Rule 2: a change takes effect only as a whole specification, through the keeper.
Rule 3: in any state but PreOp the dictionaries show the running specification.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any, TypeAlias, TypeVar

from eap.device.configuration import (
    StoredError,
    adopt_configuration,
    load_configuration,
    read_configuration,
    restore_configuration,
)
from eap.device.eap_dictionary import DeviceIdentity, EapDictionary, LiveValues
from eap.device.eap_spec import read_back
from eap.device.eap_state import EapStateMachine, StateResult
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.model import OdState
from eap.pd.device import DeviceFault, DeviceState, FaultCode
from eap.pd.handover import PORT_CONTENT, describe_port_changes, port_changes
from eap.pd.spec import StationSpec
from eap.runtime.device_change import (
    Plan,
    dump_all,
    eap_ports,
    fill_all,
    find_refusals,
    make_plan,
)
from eap.runtime.device_change import plan_rollback as make_rollback
from eap.runtime.draft import Download, DraftFile
from eap.runtime.store import Configuration, digest_of
from eap.services.device.station_keeper import StationKeeper
from eap.services.tasks import JobQueue

_CONTROL = 0xF200
_STATES = frozenset((DeviceState.PREOP, DeviceState.SAFEOP, DeviceState.OP))

ResultT = TypeVar("ResultT")
Run: TypeAlias = Callable[[StationSpec, dict[str, Any]], Awaitable[None]]

logger = logging.getLogger(__name__)


class StationDevice:
    """One station's device.

    Args:
        keeper: Of what it runs.
        values: Where live entries get theirs.
        identity: What 0x1000 to 0x1018 show.
        draft: Where downloads in PreOp are kept.

    Attributes:
        dictionaries: By name of the EAP port.
    """

    def __init__(
        self,
        keeper: StationKeeper,
        values: LiveValues,
        identity: DeviceIdentity,
        draft: DraftFile,
    ) -> None:
        self.name = keeper.spec.name
        self._keeper = keeper
        self._values = values
        self._identity = identity
        self._draft = draft
        self._base = ""
        """Digest of the configuration that the draft begins with; empty without a draft."""
        self._jobs = JobQueue(f"station {self.name}")
        self.dictionaries = {
            name: EapDictionary(keeper.spec, name, values, identity)
            for name in eap_ports(keeper.spec)
        }
        self._incomplete: DeviceFault | None = None
        self._is_written = False
        try:
            fill_all(self.dictionaries, keeper.objects)
        except DeviceFault as exc:
            self._incomplete = exc
            logger.warning("station %s: incomplete dictionaries: %s", self.name, exc)
        self._requested: int | None = None
        self._changed: StationSpec | None = None
        self._checked: StationSpec | DeviceFault = keeper.spec
        self._machine = EapStateMachine(
            self._confirmed_spec, _ConfirmedActions(self._confirmed_spec)
        )
        for dictionary in self.dictionaries.values():
            self._serve(dictionary)
        self._machine.start()
        if keeper.state is DeviceState.PREOP:
            self._restore_draft()
        else:
            draft.clear()
        for name, dictionary in self.dictionaries.items():
            dictionary.on_download = partial(self._keep_download, name)
        if keeper.state is not DeviceState.PREOP:
            self._machine.request(keeper.state)
        self._spec = keeper.spec
        # First: others look for the dictionaries of the ports that are there then.
        keeper.on_change.insert(0, self._follow_ports)

    @property
    def spec(self) -> StationSpec:
        """The running specification."""
        return self._keeper.spec

    @property
    def last_change(self) -> tuple[Configuration | None, str, bool]:
        """Configuration before the last change, name of that change, and whether undone."""
        return self._keeper.previous, self._keeper.cause, self._keeper.undone

    def findings(self) -> list[dict[str, Any]]:
        """Return a finding of ``status`` if the running configuration could not be stored."""
        unsaved = self._keeper.unsaved
        if unsaved is None:
            return []
        reason, _, remedy = unsaved.reason.removeprefix(f"station {self.name}: ").rpartition("; ")
        state = self._keeper.state.name
        return [
            {
                "severity": "error",
                "where": self.name,
                "what": f"{reason}; a start restores the configuration before",
                "advice": f"{remedy}, then 'eapctl state {self.name} {state}'",
                "since": unsaved.since,
            }
        ]

    @property
    def status(self) -> StateResult:
        """State, and why it is not another one."""
        return self._machine.status

    def od_state(self) -> OdState:
        """Return the rights with which clients reach the dictionaries."""
        return self._machine.od_state or OdState.PREOP

    async def resend(self) -> None:
        """Send the engine the configuration again, which it may have missed."""
        await self._jobs.run(self._keeper.resend)

    def upload(self, port: str, index: int, subindex: int, *, complete: bool = False) -> bytes:
        """Return an entry, or a whole object from *subindex* on; raise SdoAbortError."""
        dictionary = self.dictionaries[port]
        read = dictionary.upload_complete if complete else dictionary.upload
        return read(index, subindex, self.od_state())

    async def download(
        self, port: str, index: int, subindex: int, data: bytes, *, complete: bool = False
    ) -> None:
        """Write an entry, or a whole object from *subindex* on; raise SdoAbortError."""
        dictionary = self.dictionaries[port]

        def write() -> None:
            if complete:
                dictionary.download_complete(index, subindex, data, self.od_state())
            else:
                dictionary.download(index, subindex, data, self.od_state())

        await self.change(port, write)

    async def change(self, port: str, write: Callable[[], ResultT]) -> ResultT:
        """Change the dictionary of *port* by *write*, and apply the change; return its result.

        Raises:
            SdoAbortError: it, or the engine, refuses; nothing has changed.
            ControlError: too many changes wait already.
        """
        return await self._jobs.run(lambda: self._write(self.dictionaries[port], write))

    async def request_state(self, wanted: int) -> StateResult:
        """Go to the state numbered *wanted* as far as possible."""
        return await self._jobs.run(lambda: self._go_to(wanted))

    async def plan(self, spec: StationSpec) -> Plan:
        """Return the plan of the change to *spec*."""
        return await self._jobs.run(lambda: asyncio.to_thread(self._plan, spec))

    async def apply(
        self, spec: StationSpec, cause: str = "", *, of_plant_file: bool = False
    ) -> tuple[Plan, DeviceFault | None]:
        """Run *spec* in the present state; return the plan, and the fault if it does not run.

        A change of several stations in several steps has one *cause*; *of_plant_file* says that it
        is to what the plant file of the appliance says now.
        """
        run = partial(self._keeper.change, cause=cause, applied=of_plant_file)
        return await self._jobs.run(lambda: self._change(lambda: self._plan(spec), run))

    async def roll_back(self, spec: StationSpec | None = None) -> tuple[Plan, DeviceFault | None]:
        """Run the configuration before the last change; returns as :meth:`apply` does.

        *spec* is that, or what runs now, with alternates where layouts change with other stations.
        """

        def plan() -> Plan:
            return make_rollback(self.spec, self.dictionaries, self._keeper.previous, spec)

        return await self._jobs.run(lambda: self._change(plan, self._keeper.roll_back))

    def _serve(self, dictionary: EapDictionary) -> None:
        self._machine.serve(dictionary)
        dictionary.on_request = self._note_request
        dictionary.on_change = self._note_change

    def _follow_ports(self, spec: StationSpec) -> None:
        """Have a dictionary for each port of *spec*; new ones are filled by the change."""
        changes = port_changes(self._spec, spec, PORT_CONTENT)
        self._spec = spec
        for port in changes.gone:
            self._machine.withdraw(self.dictionaries.pop(port.name))
        for port in changes.added:
            name = port.name
            dictionary = EapDictionary(spec, name, self._values, self._identity)
            self.dictionaries[name] = dictionary
            self._serve(dictionary)
            dictionary.on_download = partial(self._keep_download, name)
        order = [name for name in eap_ports(spec) if name in self.dictionaries]
        for name in order:  # in the order of the ports, as after a start
            self.dictionaries[name] = self.dictionaries.pop(name)

    def _plan(self, spec: StationSpec) -> Plan:
        return make_plan(self.spec, self.dictionaries, spec, {})

    async def _change(self, make: Callable[[], Plan], run: Run) -> tuple[Plan, DeviceFault | None]:
        # A thousand PDs take a second, in which others want answers; only jobs write dictionaries.
        plan = await asyncio.to_thread(make)
        if plan.refused or (plan.is_empty and plan.spec == self.spec):
            return plan, None
        try:
            await run(plan.spec, await asyncio.to_thread(plan.objects))
        except DeviceFault as exc:
            return plan, exc
        for name, dictionary in self.dictionaries.items():
            adopt_configuration(dictionary, plan.dictionaries[name])
        self._incomplete = None
        self._forget_draft()
        return plan, None

    async def _write(self, dictionary: EapDictionary, write: Callable[[], ResultT]) -> ResultT:
        """Write to *dictionary*, and apply the change before the client is answered.

        Raises:
            SdoAbortError: it is refused, by the dictionary or by the engine; nothing has changed.
        """
        self._requested = self._changed = None
        runs = self._machine.status.state is not DeviceState.PREOP
        before = read_configuration(dictionary) if runs else {}
        result = write()
        self._is_written = self._is_written or self._requested is None
        if self._requested is not None:
            fault = (await self._go_to(self._requested)).fault
            if fault is not None:
                raise SdoAbortError(AbortCode.DEVICE_STATE, _CONTROL, 1, fault.text)
        elif self._changed is not None:
            try:
                await self._keeper.change(self._changed, dump_all(self.dictionaries))
            except DeviceFault as exc:
                restore_configuration(dictionary, before)
                raise SdoAbortError(AbortCode.PARAMETER, exc.index, exc.subindex, exc.text) from exc
        return result

    async def _go_to(self, wanted: int) -> StateResult:
        """Request the state from the engine first; then follow in the state machine."""
        state = self._machine.status.state
        try:
            if wanted in _STATES:
                await self._request_engine(state, DeviceState(wanted))
        except DeviceFault as exc:
            self._checked = exc
        return self._machine.request(wanted)

    async def _request_engine(self, state: DeviceState, wanted: DeviceState) -> None:
        self._checked = self.spec
        is_untouched = self._incomplete is not None and not self._is_written
        if state is DeviceState.PREOP and wanted is not state and not is_untouched:
            self._checked = spec = self._read_back()
            await self._keeper.change(spec, dump_all(self.dictionaries))
        await self._keeper.change_state(wanted)
        if wanted is not DeviceState.PREOP:
            self._forget_draft()

    def _restore_draft(self) -> None:
        """Repeat the downloads that an earlier services process accepted in PreOp."""
        base = digest_of(self.spec)
        draft = self._draft.read(base)
        if draft is None:
            return
        self._base, self._is_written = base, True
        done = 0
        try:
            for name, dictionary in self.dictionaries.items():
                if name in draft.objects:
                    load_configuration(dictionary, draft.objects[name])
            for each in draft.downloads:
                dictionary = self.dictionaries[each.port]
                write = dictionary.download_complete if each.complete else dictionary.download
                write(each.index, each.subindex, each.data, OdState.PREOP)
                done += 1
        except (StoredError, SdoAbortError, KeyError) as exc:
            logger.warning(
                "station %s: only %d of %d downloads in PREOP are back: %s; check the"
                " configuration before SAFEOP",
                self.name, done, len(draft.downloads), exc,
            )  # fmt: skip

    def _keep_download(
        self, port: str, index: int, subindex: int, data: bytes, complete: bool
    ) -> None:
        starts, self._base = not self._base, self._base or digest_of(self.spec)
        download = Download(port, index, subindex, data, complete)
        self._draft.append(download, self._base, lambda: dump_all(self.dictionaries), starts=starts)

    def _forget_draft(self) -> None:
        if self._base:
            self._base = ""
            self._draft.clear()

    def _read_back(self) -> StationSpec:
        """Return the specification in the dictionaries; raise DeviceFault if it cannot run."""
        if self._incomplete is not None:
            raise self._incomplete
        spec = read_back(self.spec, self.dictionaries)
        for reason in find_refusals(self.spec, spec):
            raise DeviceFault(FaultCode.PORT, reason)
        for change in describe_port_changes(self.spec, spec):
            raise DeviceFault(FaultCode.PORT, f"{change}: 'eapctl apply' changes ports")
        return spec

    def _confirmed_spec(self) -> StationSpec:
        """Return the specification that the engine accepted, or raise its fault."""
        if isinstance(self._checked, DeviceFault):
            raise self._checked
        return self._checked

    def _note_request(self, wanted: int) -> None:
        self._requested = wanted

    def _note_change(self, index: int, subindex: int) -> None:
        del index, subindex
        self._changed = self._read_back()


class _ConfirmedActions:
    """Actions of a state machine whose transitions the engine has already made."""

    def __init__(self, recall: Callable[[], StationSpec]) -> None:
        self._confirmed_spec = recall

    def start_sending(self, spec: StationSpec) -> None:
        """Nothing: the engine has it."""

    def start_receiving(self) -> None:
        """Raise DeviceFault if the engine did not go there."""
        self._confirmed_spec()

    def stop_receiving(self) -> None:
        """Nothing: the engine has stopped."""

    def stop_sending(self) -> None:
        """Nothing: the engine has stopped."""
