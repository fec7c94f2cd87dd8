from __future__ import annotations

import pytest

from eap.device.pdlayout import PdKey, kept_versions, lay_out, sent_pds
from eap.pd.spec import StationSpec, TxFrameSpec, TxPdSpec
from tests.support.cyclic import OWN, station, written


def test_variables_lie_in_pdo_order_under_the_one_name_of_their_type():
    layout = lay_out(3, [("on", "BOOL"), ("off", "bit"), ("level", "real")])
    assert (layout.version, layout.size) == (3, 5)
    assert layout.variables == (("on", "BOOL", 0), ("off", "BIT1", 1), ("level", "REAL", 8))


def test_a_pd_is_known_by_the_port_that_sends_it_and_its_id():
    pds = (TxPdSpec("p", 1, ("a",), 5), TxPdSpec("q", 2, ("a",)))
    spec = station(
        variables=written("a:UINT"), frames=(TxFrameSpec("f", "eap0", "somewhere", pds),)
    )
    assert list(sent_pds(spec)) == [
        (PdKey(OWN, 1), pds[0], lay_out(5, [("a", "UINT")])),
        (PdKey(OWN, 2), pds[1], lay_out(0, [("a", "UINT")])),
    ]


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
