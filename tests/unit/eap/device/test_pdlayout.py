from __future__ import annotations

from eap.device.pdlayout import PdKey, lay_out, sent_pds
from eap.pd.spec import TxFrameSpec, TxPdSpec
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
