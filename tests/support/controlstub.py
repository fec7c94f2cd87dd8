"""A control server whose methods a test brings: the command line's side of any conversation."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any

from eap.control.protocol import (
    Failure,
    decode_request,
    encode_error,
    encode_failure,
    encode_result,
)
from eap.errors import ControlError
from eap.od.abort import SdoAbortError
from eap.runtime.folder import ApplianceFolder, ApplianceInfo

Method = Callable[[dict[str, Any]], Any]


class ControlStub:
    """A running appliance, as far as its control socket tells.

    Attributes:
        requests: Method and parameters of all requests, in order.
    """

    def __init__(
        self,
        plant: str,
        stations: list[str],
        methods: Mapping[str, Method],
        stack: ExitStack,
        *,
        plant_file: str = "plant.yaml",
    ) -> None:
        self.requests: list[tuple[str, dict[str, Any]]] = []
        self._methods = methods
        folder = stack.enter_context(ApplianceFolder.claim(plant))
        folder.write_info(ApplianceInfo(plant, plant_file, stations, "", 1))
        self._listener = stack.enter_context(socket.socket(socket.AF_UNIX))
        self._listener.bind(str(folder.control_socket))
        self._listener.listen()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()
        stack.callback(self._stop)

    def _stop(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._thread.join()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            with connection, connection.makefile("rb") as lines:
                for line in lines:
                    connection.sendall(self._answer(line))

    def _answer(self, line: bytes) -> bytes:
        request = decode_request(line)
        self.requests.append((request.method, request.params))
        try:
            return encode_result(request.id, self._methods[request.method](request.params))
        except SdoAbortError as exc:
            return encode_failure(request.id, Failure("abort", str(exc), "", exc.code))
        except ControlError as exc:
            return encode_error(request.id, exc)
