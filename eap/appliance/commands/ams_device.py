"""A device that is asked by ADS, through the router of a running appliance."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from eap.aoe.ads_operation import Operation, OperationOutcome, ReadState
from eap.aoe.ads_query import decode_outcome, encode_query
from eap.appliance.commands.ams import first_that_knows
from eap.appliance.commands.client import Client
from eap.appliance.control import ErrorCode
from eap.codec.ads import AdsError
from eap.errors import ControlError

PATIENCE_S = 10.0
_ON_THE_WAY = frozenset((AdsError.TARGET_MACHINE, AdsError.HOST_UNREACHABLE, AdsError.TIMEOUT))
"""Errors of routers between here and the device."""
_WORDS: dict[int, str] = {
    AdsError.ACCESS: "it may not be read or written so",
    AdsError.SIZE: "the wrong number of octets",
    AdsError.VALUE: "not a value for it",
    AdsError.NOT_FOUND: "there is no such object or entry",
    AdsError.STATE: "not in the state that the device is in",
    AdsError.SERVICE: "the device cannot do that",
    AdsError.INDEX_GROUP: "the device has no object dictionary",
    AdsError.GENERAL: "the device refuses",
}


class AmsRefusedError(ControlError):
    """The device refuses, or nobody gets to it; *result* is that of ADS."""

    def __init__(self, message: str, result: int) -> None:
        super().__init__(message, code=ErrorCode.REFUSED)
        self.result = result


class AmsDevice:
    """One device; *target* is ``STATION[/PORT[/SLAVE]]`` or ``NETID[:PORT]``."""

    def __init__(self, client: Client, target: str) -> None:
        self.target = target
        self._client = client

    def ask(self, operation: Operation) -> OperationOutcome:
        """Return how one operation came out; raise ControlError if there is no such target."""
        command, body = encode_query(operation)
        answer = self._client.request_within(
            PATIENCE_S, "ams_ask", target=self.target, command=command, data=body.hex(), device=True
        )
        return decode_outcome(command, answer["error"], bytes.fromhex(answer["data"]))

    def demand(self, operation: Operation, what: str) -> bytes:
        """Return the data of an answer.

        Args:
            operation: What is asked for.
            what: That, in words.

        Raises:
            AmsRefusedError: the device refuses, or nobody gets to it.
        """
        outcome = self.ask(operation)
        if outcome.result:
            raise self.refusal(outcome.result, what)
        return outcome.data

    def refusal(self, result: int, what: str) -> AmsRefusedError:
        """Return the error that tells of *result*."""
        if result in _ON_THE_WAY and (why := self._find_fault()):
            return AmsRefusedError(f"{self.target}: {what}: {why}", result)
        text = _WORDS.get(result)
        said = f"{text} (error 0x{result:x})" if text else AdsError.words_of(result)
        hint = "" if text else f"; 'eapctl trace {self.target}' shows where"
        return AmsRefusedError(f"{self.target}: {what}: {said}{hint}", result)

    def _find_fault(self) -> str:
        """Return at which router the way to the device ends, and why; empty if that is unknown."""
        try:
            found = self._client.request_within(PATIENCE_S, "trace", target=self.target)
        except ControlError:
            return ""
        return str(found["why"])


@contextmanager
def open_ams(target: str, plant: str | None) -> Iterator[AmsDevice]:
    """Reach *target* through the first appliance that knows it.

    Raises:
        ControlError: nothing runs, or nobody knows the target.
    """
    with first_that_knows(lambda each: AmsDevice(each, target).ask(ReadState()), plant) as found:
        client, _ = found
        yield AmsDevice(client, target)
