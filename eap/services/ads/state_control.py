"""WriteControl to a station: its EAP devices go to the state that is asked for, if they can."""

from __future__ import annotations

from eap.ads.operation import AdsRefusedError, OperationOutcome, WriteControl
from eap.ads.space import al_state_for
from eap.codec.ads import AdsError
from eap.errors import ControlError
from eap.services.device.station_device import StationDevice


async def control_state(device: StationDevice, request: WriteControl) -> OperationOutcome:
    """Bring *device* to a state; the outcome says why it is not there."""
    try:
        fault = (await device.request_state(al_state_for(request.ads_state))).fault
    except AdsRefusedError as exc:
        return OperationOutcome(
            exc.result, why=f"no state belongs to ADS state {request.ads_state}"
        )
    except ControlError as exc:
        return OperationOutcome(AdsError.BUSY, why=str(exc))
    return OperationOutcome() if fault is None else OperationOutcome(AdsError.STATE, why=fault.text)
