"""What services ask of the engine for a station: another specification, another state."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

from eap.errors import EnvironmentalError
from eap.pd import pieces
from eap.pd.device import DeviceState
from eap.pd.spec import StationSpec
from eap.runtime.station_request import Configure, SetState
from eap.services.engine_link import EngineLink

CONFIGURE_S = 60.0
STATE_S = 5.0


class EngineClient:
    """Asks for changes of running stations.

    Args:
        link: Services' end of the pair with the engine.
        folder: Where both may read and write: the appliance's runtime folder.
    """

    def __init__(self, link: EngineLink, folder: Path) -> None:
        self._link = link
        self._folder = folder
        self._numbers = itertools.count(1)

    async def configure(self, station: str, spec: StationSpec) -> None:
        """Have *station* run *spec* from its next cycle on.

        Raises:
            EngineRefusedError: it goes on with what it ran before; the text says why.
            EngineGoneError: no engine answers, or it was started again meanwhile; one that is
                started runs what has been stored.
            EnvironmentalError: the runtime folder cannot be written.
        """
        path = self._folder / f".{os.getpid()}-{next(self._numbers)}.spec"
        try:
            path.write_bytes(pieces.to_lines(spec))
        except OSError as exc:
            path.unlink(missing_ok=True)
            raise EnvironmentalError(f"{path}: {exc.strerror}") from None
        try:
            await self._link.request(
                lambda number: Configure(id=number, station=station, path=str(path)), CONFIGURE_S
            )
        finally:
            path.unlink(missing_ok=True)

    async def set_state(self, station: str, state: DeviceState) -> None:
        """Bring *station* to PreOp, SafeOp or Op; raises as :meth:`configure` does."""
        await self._link.request(
            lambda number: SetState(id=number, station=station, state=state), STATE_S
        )
