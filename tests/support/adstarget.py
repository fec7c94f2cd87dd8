"""An appliance that reaches one device by ADS: its control socket, and the device behind it."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

from eap.ads.device import AdsDevice
from eap.ads.notifications import AdsClient
from eap.ads.objects import ObjectSpace
from eap.ads.request import WriteControl
from eap.ads.space import al_state_for, states_of
from eap.codec.ads import AdsDeviceInfo, AdsStates, device_name
from eap.control.protocol import ErrorCode
from eap.control.routes import TracedPath
from eap.errors import ControlError
from eap.ids import Endpoint, NetId
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdState
from tests.support.controlstub import ControlStub

TARGET = "far/bus0/1001"
NOBODY = AdsClient(Endpoint("local", "1"), NetId(bytes(6)), 1)


class AdsTarget:
    """The device with the name TARGET.

    Attributes:
        al_state: That it is in.
        slow: How often it tells of its old state before it is in a new one.
        error: Of the AMS header, in place of any answer.
        why: Result of a trace: the router at which the way to the device ends.
    """

    def __init__(self, dictionary: ObjectDictionary, stack: ExitStack) -> None:
        self.al_state = 2
        self.slow = 0
        self.error = 0
        self.why = ""
        self._wanted = 2
        info = AdsDeviceInfo(1, 0, 0, device_name("far"))
        space = ObjectSpace(dictionary, lambda: OdState.PREOP)
        self._device = AdsDevice(info, self._states, [space], control=self._take)
        methods = {"ams_ask": self._ask, "trace": self._trace}
        self.stub = ControlStub("line", ["near"], methods, stack)

    def _ask(self, params: dict[str, Any]) -> dict[str, Any]:
        if params["target"] != TARGET:
            raise ControlError("no such station in this plant", code=ErrorCode.UNKNOWN_NAME)
        if self.error:
            return {"error": self.error, "data": ""}
        body = bytes.fromhex(params["data"])
        answer = self._device.answer(params["command"], body, NOBODY, 0)
        return {"error": answer.error_code, "data": answer.data.hex()}

    def _trace(self, params: dict[str, Any]) -> TracedPath:
        return TracedPath(params["target"], "", "", not self.why, self.why, [], None)

    def _states(self) -> AdsStates:
        if self._wanted != self.al_state:
            self.slow -= 1
            if self.slow < 0:
                self.al_state = self._wanted
        return states_of(self.al_state)

    def _take(self, request: WriteControl) -> None:
        self._wanted = al_state_for(request.ads_state)
