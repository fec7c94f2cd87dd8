from __future__ import annotations

from eap.config.document import Node
from eap.config.finding import FindingReport, PlantFinding, one_beside, one_of


def test_a_finding_reads_as_file_line_what_and_what_was_expected():
    finding = PlantFinding("p.yaml", 7, "stations[0].publish[1].id", "id is 'x'", "a whole number")
    assert str(finding) == "p.yaml:7: id is 'x'; expected a whole number"


def test_a_finding_of_the_whole_file_has_no_line():
    assert str(PlantFinding("p.yaml", 0, "", "is a directory", "a file")).startswith("p.yaml: is")


def test_a_path_without_a_line_of_its_own_has_that_of_what_holds_it():
    report = FindingReport("p.yaml")
    report.lines |= {"": 1, "stations[0]": 4, "stations[0].ports[1]": 9}
    assert report.line_of("stations[0].ports[1].vlan.id") == 9
    assert report.line_of("stations[0].cycle_us") == 4
    assert report.line_of("defaults") == 1


def test_findings_are_in_file_order_without_duplicates():
    report = FindingReport("p.yaml")
    report.add("b", "second", "x", line=5)
    report.add("a", "first", "x", line=2)
    report.add("c", "second", "x", line=5)
    assert [(f.line, f.path) for f in report.findings()] == [(2, "a"), (5, "b")]


def test_one_of_nothing_says_so():
    assert one_of(["a", "b"]) == "one of a, b"
    assert one_of([]) == "none (there are none here)"


def test_one_beside_lists_what_begins_as_the_unknown_name_does():
    known = [f"bus0.s{n}.{each}" for n in range(9) for each in ("in", "out")]
    assert one_beside("bus0.s3.inn", known) == "one of bus0.s3.in, bus0.s3.out"
    assert one_beside("bus0.s3.a.b", known) == "one of bus0.s3.in, bus0.s3.out"
    assert one_beside("other", known).startswith("one of bus0.s0.in, ")
    assert one_beside("other", known).endswith(" and 6 more")
    assert one_beside("a", ["x", "y"]) == "one of x, y"


def test_findings_of_other_files_come_last():
    report = FindingReport("p.yaml")
    report.adopt([PlantFinding("bus.yaml", 1, "", "wrong", "right")])
    report.add("a", "first", "x", line=2)
    assert [str(f) for f in report.findings()] == [
        "p.yaml:2: first; expected x",
        "bus.yaml:1: wrong; expected right",
    ]


def test_report_has_finding_of_path():
    report = FindingReport("p.yaml")
    report.add("a.b", "first", "x", line=2)
    assert report.has("a.b")
    assert not report.has("a")


def shared_report():
    """Return the report of two stations that share a mapping with the keys a and b."""
    report = FindingReport("p.yaml")
    report.stations |= {"oven", "press"}
    a, b = Node(2, 1), Node(2, 2)
    for number in range(2):
        report.enter(f"stations[{number}].a", 2, a)
        report.enter(f"stations[{number}].b", 2, b)
    return report


def test_finding_of_an_anchor_is_reported_once_with_the_number_of_its_places():
    report = shared_report()
    report.add("stations[0].a", "station oven has no port 'x', did you mean y?", "one of y")
    report.add("stations[1].a", "station press has no port 'x'", "one of z")
    (finding,) = report.findings()
    assert str(finding) == (
        "p.yaml:2: station oven has no port 'x', did you mean y?"
        " (and in 1 more place, by an anchor); expected one of y"
    )
    assert report.has("stations[0].a")
    assert report.has("stations[1].a")


def test_different_findings_of_an_anchor_are_all_reported():
    report = shared_report()
    report.add("stations[0].a", "unknown key 'a'", "b")
    report.add("stations[0].b", "unknown key 'b'", "a")
    report.add("stations[1].a", "a is too small", "5")
    assert len(report.findings()) == 3


def test_findings_of_one_place_are_never_merged():
    report = shared_report()
    report.add("stations[0].a", "nothing is called 'x'", "y")
    report.add("stations[0].a", "nothing is called 'z'", "y")
    assert len(report.findings()) == 2
