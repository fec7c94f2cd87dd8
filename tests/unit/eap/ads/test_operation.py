from __future__ import annotations

from eap.ads.operation import AdsRefusedError, OperationOutcome
from eap.codec.ads import AdsError


def test_refusal_says_its_result() -> None:
    assert str(AdsRefusedError(AdsError.SIZE)) == "SIZE"
    assert str(AdsRefusedError(AdsError.SIZE, "too long")) == "SIZE: too long"
    assert OperationOutcome() == (AdsError.NONE, b"", "")
