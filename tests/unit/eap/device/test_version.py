from __future__ import annotations

import pytest

from eap.device.version import kept_versions
from eap.pd.spec import StationSpec, TxFrameSpec, TxPdSpec
from tests.support.cyclic import station, written


def sending(version: int, *variables: str, pd_id: int = 7) -> StationSpec:
    """A station that sends *variables*, written as ``name:type``, as one PD."""
    names = tuple(variable.partition(":")[0] for variable in variables)
    pd = TxPdSpec("report", pd_id, names, version)
    return station(
        variables=written(*variables), frames=(TxFrameSpec("f", "eap0", "somewhere", (pd,)),)
    )


@pytest.mark.parametrize(
    ("new", "told"),
    [
        (sending(1, "a:UINT", "b:UINT", "c:BOOL"), "changes from 4 to 5 octets"),
        (sending(1, "a:UINT"), "changes from 4 to 2 octets"),
        (sending(1, "a:UINT", "b:INT"), "keeps its size with other variables"),
        (sending(1, "a:UDINT"), "keeps its size with other variables"),
        (sending(1, "b:UINT", "a:UINT"), "keeps its size with other variables"),
        (sending(1, "c:UINT", "a:UINT"), "keeps its size with other variables"),
    ],
)
def test_a_layout_that_changes_under_its_version_is_told(new, told):
    (line,) = kept_versions(sending(1, "a:UINT", "b:UINT"), new)
    assert line.startswith(f"PD 'report' (id 7) {told}")
    assert "its version stays 1" in line


@pytest.mark.parametrize(
    "new",
    [
        sending(1, "a:UINT", "b:UINT"),
        sending(1, "a:UINT", "renamed:UINT"),
        sending(2, "a:UINT"),
        sending(1, "a:UDINT", pd_id=8),
        station(),
    ],
)
def test_what_every_subscriber_can_tell_is_not(new):
    assert kept_versions(sending(1, "a:UINT", "b:UINT"), new) == []
