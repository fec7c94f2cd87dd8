"""Status documents of several appliances as one."""

from eap.live.status import ApplianceStatus, MergedStatus


def test_status_of_several_becomes_one():
    first = {"version": 1, "plant": "p", "processes": {"engine": {}}, "stations": [{"name": "a"}]}
    second = {"version": 1, "plant": "q", "processes": {}, "stations": [{"name": "b"}]}
    merged = MergedStatus.of([first, second])
    assert merged.processes == {"engine": {}}
    assert [station["name"] for station in merged.stations] == ["a", "b"]
    assert [station["plant"] for station in merged.stations] == ["p", "q"]
    assert merged.appliances == [
        ApplianceStatus("p", ["a"], {"engine": {}}, findings=[], audit=None, listeners=[]),
        ApplianceStatus("q", ["b"], {}, findings=[], audit=None, listeners=[]),
    ]
