from __future__ import annotations

import re
import textwrap

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ams.spec import Role
from eap.config.index import ExpectedBus
from eap.config.listen import parse_listen, role_of_anonymous
from eap.config.load import PlantResult, load
from eap.config.web import window_s
from eap.config.web_sections import WebSection
from eap.patterns import match_names
from tests.support.passwords import HASH

PLANT = """\
plant: line
stations:
  - name: mixer
    net_id: 10.0.0.1.1.1
    ports: [{name: eap0, kind: eap, interface: "udp://127.0.0.1", net_id: 10.0.0.1.2.1}]
    variables:
      speed: {type: UDINT, unit: 1/min}
      setpoint: UINT
      text: STRING(8)
      path: "UINT[4]"
      copy: UINT
    sources: {speed: {kind: counter}}
    links: [{from: setpoint, to: copy}]
    frames: [{name: out, port: eap0, to: 127.0.0.2}]
    publish: [{name: state, frame: out, id: 1, variables: [speed]}]
"""


def result(tmp_path, web: str) -> PlantResult:
    file = tmp_path / "plant.yaml"
    file.write_text(PLANT + textwrap.dedent(web))
    return load(file, lambda path: ExpectedBus())


def findings(tmp_path, web: str) -> list[str]:
    found = result(tmp_path, web).findings
    return [re.sub(r"^.*?plant.yaml:\d+: ", "", str(each)) for each in found]


def panel(tmp_path, text: str) -> list[str]:
    web = f"web:\n  pages:\n    - {{name: Line, panels: [{text}]}}\n"
    return findings(tmp_path, web)


@pytest.mark.parametrize(
    "text",
    [
        "{kind: value, of: mixer/speed, warn: 70, alarm: 80.5, decimals: 1}",
        "{kind: value, of: [mixer/s*, '*/copy']}",
        "{kind: trend, of: [mixer/speed, mixer/copy], window: 90s, min: 0, max: 10}",
        "{kind: states}",
        "{kind: states, of: mixer/state}",
        "{kind: set, of: mixer/setpoint, min: 0, max: 100, for: engineer, comment: required}",
        "{kind: set, of: 'mixer/path[2]', min: 0}",
        "{kind: set, of: mixer/state.VarCtrl}",
        "{kind: set, of: mixer/text}",
        "{kind: events, from: warning, of: mixer}",
        "{kind: bus}",
        "{kind: plant}",
        "{kind: routes, of: mixer}",
        "{kind: variables, of: 'mixer/*'}",
    ],
)
def test_panel_is_right(tmp_path, text):
    assert panel(tmp_path, text) == []


@pytest.mark.parametrize(
    ("text", "finding"),
    [
        (
            "{kind: value, of: mixer/sped}",
            "station mixer has no variable 'sped', did you mean speed?",
        ),
        ("{kind: value, of: mixr/speed}", "unknown station 'mixr', did you mean mixer?"),
        ("{kind: value, of: speed}", "'speed' names no variable; expected STATION/VARIABLE"),
        ("{kind: value, of: 'mixer/x*'}", "no variable fits 'mixer/x*'"),
        ("{kind: value, of: 'mixer/path[9]'}", "station mixer has no variable 'path[9]'"),
        ("{kind: value}", "item 1 of panels has no of"),
        ("{kind: valu, of: mixer/speed}", "unknown kind 'valu', did you mean value?"),
        ("{of: mixer/speed}", "item 1 of panels is a mapping; expected a mapping with a kind"),
        ("{kind: value, of: mixer/speed, variable: x}", "unknown key 'variable'"),
        ("{kind: trend, of: mixer/speed, window: 10}", "window: '10' is not a time"),
        ("{kind: trend, of: mixer/speed, window: 1s}", "window: '1s' is out of range"),
        ("{kind: trend, of: mixer/speed, min: 2, max: 1}", "min 2 is not below max 1"),
        ("{kind: set, of: mixer/speed}", "variable mixer/speed cannot be set: it has a source"),
        ("{kind: set, of: mixer/copy}", "variable mixer/copy cannot be set: a link writes it"),
        ("{kind: set, of: mixer/text, max: 5}", "variable mixer/text is no number"),
        ("{kind: set, of: mixer/setpoint, min: 5, max: 5}", "min 5 is not below max 5"),
        ("{kind: set, of: mixer/setpoint, for: viewer}", "viewers set nothing"),
        ("{kind: set, of: mixer/setpoint, step: 0}", "step is 0; expected more than 0"),
        ("{kind: events, from: bad}", "from is 'bad'; expected one of info, warning, error"),
        ("{kind: events, of: mixr}", "unknown station 'mixr', did you mean mixer?"),
        ("{kind: bus, of: mixer/bus0}", "unknown bus 'mixer/bus0'"),
        ("{kind: picture, file: no.svg}", "no.svg: No such file or directory"),
    ],
)
def test_wrong_panel_is_a_finding(tmp_path, text, finding):
    (found,) = panel(tmp_path, text)
    assert found.startswith(finding)


def test_picture_is_checked_against_its_variables(tmp_path):
    svg = '<svg xmlns="http://www.w3.org/2000/svg"><rect id="tank"/><script/></svg>'
    (tmp_path / "a.svg").write_text(svg)
    bind = '"#tank": mixer/speed, "#tnk": mixer/sped, tank: {of: mixer/speed, min: 3, max: 2}'
    found = panel(tmp_path, f"{{kind: picture, file: a.svg, bind: {{{bind}}}}}")
    assert {each.partition(";")[0] for each in found} == {
        "a.svg has no element '#tnk', did you mean tank?",
        "station mixer has no variable 'sped', did you mean speed?",
        "'tank' is no element",
        "min 3 is not below max 2",
    }


def test_picture_with_a_script_is_a_warning(tmp_path):
    svg = '<svg xmlns="http://www.w3.org/2000/svg"><rect id="tank"/><script/></svg>'
    (tmp_path / "a.svg").write_text(svg)
    web = "web: {pages: [{name: A, panels: [{kind: picture, file: a.svg}]}]}\n"
    found = result(tmp_path, web)
    assert found.findings == ()
    assert [each.message for each in found.warnings] == ["a.svg: the page leaves out script"]
    assert found.plant.web.pages[0].panels[0].file == str(tmp_path / "a.svg")


@pytest.mark.parametrize(
    ("web", "finding"),
    [
        ("{listen: 8080}", "listen: '8080' is not an address with a port"),
        ("{listen: 'localhost:8080'}", "listen: 'localhost' is not an IP address"),
        ("{listen: '127.0.0.1:0'}", "listen: '127.0.0.1:0' is not an address with a port"),
        ("{hosts: [a b]}", "'a b' is no name of a host"),
        ("{users: [{name: 'a:b', password: HASH}]}", "user 'a:b'; expected a name without colons"),
        ("{users: [{name: a, password: secret}]}", "user a: the password is no hash of scrypt"),
        ("{users: [{name: a}]}", "user a: the password is no hash of scrypt"),
        (
            "{users: [{name: a, password: HASH}, {name: a, password: HASH}]}",
            "user a is there twice",
        ),
        (
            "{users: [{name: a, role: admin, password: HASH}]}",
            "role is 'admin'; expected one of viewer",
        ),
        ("{tls: {certificate: a.crt, key: b.key}}", "a.crt: No such file"),
        (
            "{proxy: {header: 'X User'}, users: [{name: a}]}",
            "header 'X User' is no name of a header",
        ),
        (
            "{proxy: {header: X-User, from: [x]}, users: [{name: a}]}",
            "'x' is no address and no network",
        ),
        ("{proxy: {header: X-User, from: []}, users: [{name: a}]}", "from is empty"),
        (
            "{proxy: {header: X-User, from: [0.0.0.0/0]}, users: [{name: a}]}",
            "0.0.0.0/0: every host could name itself any user",
        ),
        ("{proxy: {header: X-User}}", "a proxy without users"),
        ("{pages: [{name: ' ', panels: []}]}", "the page has an empty name"),
        ("{pages: [{name: A, panels: []}, {name: A, panels: []}]}", "page 'A' is there twice"),
    ],
)
def test_wrong_key_is_a_finding(tmp_path, web, finding):
    found = findings(tmp_path, f"web: {web}\n".replace("HASH", f'"{HASH}"'))
    assert found
    assert found[0].startswith(finding)


def test_other_hosts_need_users_and_tls(tmp_path):
    found = findings(tmp_path, "web: {listen: '0.0.0.0:8080', anonymous: operator}\n")
    assert [each.partition(";")[0] for each in found] == [
        "listen: 0.0.0.0:8080 is reached by other hosts, and there are no users",
        "listen: 0.0.0.0:8080 is reached by other hosts, and there is no tls",
        "anonymous: every host would be operator without a password",
    ]
    for name in ("a.crt", "a.key"):
        (tmp_path / name).write_text("")
    web = f"""\
    web:
      listen: "[::]:8443"
      anonymous: viewer
      tls: {{certificate: a.crt, key: a.key}}
      users: [{{name: anna, role: operator, password: "{HASH}"}}]
    """
    found = result(tmp_path, web)
    assert found.findings == ()
    assert found.plant.web.tls.key == str(tmp_path / "a.key")


def test_short_form_is_the_address(tmp_path):
    found = result(tmp_path, "web: 127.0.0.1:8081\n")
    assert found.plant.web.listen == "127.0.0.1:8081"
    assert found.plant.web.pages == ()
    assert result(tmp_path, "").plant.web is None


def test_trends_are_bounded(tmp_path):
    file = tmp_path / "plant.yaml"
    names = "".join(f"      v{number}: UINT\n" for number in range(201))
    own = PLANT.replace("    variables:\n", f"    variables:\n{names}")
    file.write_text(own + "web: {pages: [{name: A, panels: [{kind: trend, of: 'mixer/v*'}]}]}\n")
    (found,) = load(file, lambda path: ExpectedBus()).findings
    assert found.message == "the trends show 201 variables"


@pytest.mark.parametrize(
    ("text", "url"),
    [
        ("127.0.0.1:80", "http://127.0.0.1:80/"),
        ("[::1]:8080", "http://[::1]:8080/"),
        ("0.0.0.0:8080", "http://localhost:8080/"),
        ("[::]:8080", "http://localhost:8080/"),
    ],
)
def test_listen_is_an_address_for_browsers(text, url):
    assert parse_listen(text).url("http") == url


def test_windows():
    assert [window_s(text) for text in ("10s", "90s", "10m", "24h")] == [10, 90, 600, 86_400]


def test_names_fit_patterns():
    names = ["a/x", "a/x.y", "b/x", "b/(z)"]
    assert match_names("*/x", names) == ["a/x", "b/x"]
    assert match_names("a/*", names) == ["a/x", "a/x.y"]
    assert match_names("*", names) == []
    assert match_names("b/(*)", names) == ["b/(z)"]
    assert match_names("a/.", names) == []
    assert match_names("*/*x*", names) == ["a/x", "a/x.y", "b/x"]
    assert match_names("a/x*x", names) == []


def test_pattern_with_many_asterisks_is_matched_at_once():
    name = f"line/{'a' * 60}"
    assert match_names(f"*/{'*a' * 40}b", [name]) == []
    assert match_names(f"*/{'*a' * 40}", [name]) == [name]


@given(st.text("ab*/", max_size=8), st.text("ab/", max_size=8))
def test_pattern_fits_as_its_regular_expression(pattern, name):
    expression = "[^/]*".join(map(re.escape, pattern.split("*")))
    assert bool(match_names(pattern, [name])) == bool(re.fullmatch(expression, name))


def test_role_without_login():
    assert role_of_anonymous(WebSection()) is Role.ENGINEER
    assert role_of_anonymous(WebSection(anonymous=Role.VIEWER)) is Role.VIEWER
