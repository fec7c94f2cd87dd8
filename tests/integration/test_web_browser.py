"""The page in a browser: every kind of view, set points, roles, restarts, widths, languages."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tests.support.appliance import EAPCTL, Appliance, Plants, SharedAppliance, plants, wait_until
from tests.support.browser import Tab, Tabs, browser
from tests.support.passwords import HASH, PASSWORD

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Route

pytestmark = [pytest.mark.net, pytest.mark.chromium, pytest.mark.timeout(300)]

CONFIG = Path(__file__).parents[2] / "config"
URL = "http://127.9.62.9:8080"
USERS = f"""\
  anonymous: viewer
  users:
    - {{name: otto, role: operator, password: "{HASH}"}}
    - {{name: elsa, role: engineer, password: "{HASH}"}}
"""
PICTURE_PAGE = """\
    - name: Picture
      panels:
        - kind: picture
          file: oven.svg
          bind:
            "#reading": island-02/temperature
            "#level": {of: island-02/temperature, show: level, min: 0, max: 400}
            "#lamp": {of: island-02/temperature, warn: 1, alarm: 500}
            "#hand": {of: island-02/temperature, show: turn}
            "#off": {of: island-03/alarm, show: visible}
        - kind: trend
          of: [island-02/temperature, island-02/pressure, island-03/position]
          window: 30s
"""
PICTURE = """\
<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 200 100" width="200" height="100">
  <rect id="level" x="10" y="10" width="30" height="80" fill="#888" style="stroke: black"/>
  <circle id="lamp" cx="80" cy="50" r="20" fill="#ccc"/>
  <line id="hand" x1="110" y1="50" x2="140" y2="50" stroke="black"/>
  <rect id="off" x="150" y="10" width="20" height="20"/>
  <text id="reading" x="120" y="90">?</text>
</svg>
"""
VIEWS = (
    "page/Line",
    "page/Plant",
    "page/Variables",
    "page/Picture",
    "station/island-02",
    "variable/island-02/temperature",
    "variable/island-03/alarm_text",
    "events/",
    "plant/",
    "login",
)


@pytest.fixture(scope="module")
def chromium() -> Iterator[Tabs]:
    with browser() as found:
        yield found


@pytest.fixture(scope="module")
def folder() -> Iterator[Plants]:
    with plants() as found:
        yield found


@pytest.fixture(scope="module")
def demo(folder: Plants) -> SharedAppliance:
    shutil.copytree(CONFIG / "buses", folder.folder / "buses")
    (folder.folder / "oven.svg").write_text(PICTURE)
    text = (CONFIG / "demo.yaml").read_text()
    text = text.replace("  listen: 127.0.0.1:8080\n", f"  listen: {URL[7:]}\n{USERS}")
    path = folder.write(f"{text}{PICTURE_PAGE}", "demo.yaml")
    return SharedAppliance(lambda: folder.run(path))


@pytest.fixture
def plant(demo: SharedAppliance) -> Appliance:
    return demo.running()


@pytest.fixture
def tab(chromium: Tabs, plant: Appliance) -> Iterator[Callable[..., Tab]]:
    """Make tabs; in none of them may anything go wrong unless the test empties its complaints."""
    wait_for_page(plant)
    made: list[Tab] = []

    def make(**context: Any) -> Tab:
        made.append(chromium.make(URL, **context))
        return made[-1]

    yield make
    # A plant on a busy host may not answer in time, which the page then says.
    complaints = [each for one in made for each in one.complaints if "503" not in each]
    for one in made:
        one.close()
    assert complaints == []


def wait_for_page(plant: Appliance) -> None:
    def runs() -> bool:
        page = plant.status()["processes"]["web"]
        return page["pid"] is not None and "step" not in page and not page.get("fault")

    wait_until(runs)


def wait_for_change(locator: Locator) -> None:
    before = locator.text_content()
    wait_until(lambda: locator.text_content() != before)


@pytest.mark.parametrize("address", VIEWS)
def test_page_shows_its_panels(tab: Callable[..., Tab], address: str):
    page = tab().open(address)
    page.locator("main h1").wait_for()
    panels = page.locator("main .panel")
    panels.first.wait_for()
    assert page.locator("main h1").inner_text() != "Not found"
    for panel in panels.all():
        panel.locator("> :not(h2)").first.wait_for()
        assert panel.locator("> :not(h2)").first.inner_text().strip()
    for table in page.locator("main table").all():
        assert table.locator("caption").count() == 1
        assert table.locator("thead th:not([scope=col])").count() == 0
    for width in (390, 800, 1920):
        page.set_viewport_size({"width": width, "height": 844})
        assert page.evaluate("document.scrollingElement.scrollWidth") <= width


def test_view_of_unknown_variable_says_so(tab: Callable[..., Tab]):
    page = tab().open("variable/island-01/<b>nothing</b>")
    page.get_by_text("no page, station or variable island-01/<b>nothing</b>").wait_for()


def test_values_move_in_all_panels_with_values(tab: Callable[..., Tab]):
    page = tab().open("page/Line")
    wait_for_change(page.locator(".panel-value .number").nth(1))
    wait_for_change(page.locator(".panel-trend .legend .number").first)
    assert page.locator(".panel-trend canvas").count() == 2
    page = tab().open("page/Variables")
    row = page.locator("tr", has_text="island-02/temperature")
    wait_for_change(row.locator("td.number").first)
    row.scroll_into_view_if_needed()
    row.locator("polyline[points]").wait_for()
    page = tab().open("page/Plant")
    page.locator("details summary").first.click()
    wait_for_change(page.locator(".panel-plant tbody td.number").nth(1))


def test_trend_is_held_zoomed_followed_and_saved(tab: Callable[..., Tab]):
    page = tab().open("page/Line")
    panel = page.locator(".panel-trend").first
    hold = panel.get_by_role("button", name="Pause")
    wait_for_change(panel.locator(".legend .number").first)
    panel.locator("canvas").wait_for()
    curve = panel.locator(".u-over").bounding_box()
    assert curve is not None
    right, top = curve["x"] + curve["width"], curve["y"] + 40
    page.mouse.move(right - 60, top)
    page.mouse.down()
    page.mouse.move(right - 5, top, steps=3)
    page.mouse.up()
    panel.get_by_role("button", name="Live").wait_for()
    with page.expect_download() as waiting:
        panel.get_by_role("button", name="CSV").click()
    assert waiting.value.suggested_filename.startswith("Oven-20")
    head, *rows = Path(waiting.value.path()).read_text().splitlines()
    assert head == 'time,"island-02/temperature [degC]","island-03/left-state.temperature [degC]"'
    first, last = (datetime.fromisoformat(each.partition(",")[0]) for each in (rows[0], rows[-1]))
    assert 1 < (last - first).total_seconds() < 20  # 55 pixels of two minutes
    assert all(160 < float(each.split(",")[1]) < 200 for each in rows if each.split(",")[1])

    page.mouse.dblclick(right - 30, top)
    hold.wait_for()
    panel.get_by_label("Time range").select_option("30s")
    hold.click()
    panel.get_by_role("button", name="Live").click()
    hold.wait_for()


def test_trend_is_read_by_keys(tab: Callable[..., Tab]):
    page = tab().open("page/Line")
    panel = page.locator(".panel-trend").first
    plot = panel.get_by_role("slider")
    wait_for_change(panel.locator(".legend .number").first)
    plot.focus()
    page.keyboard.press("End")
    page.keyboard.press("ArrowLeft")
    reading = plot.get_attribute("aria-valuetext") or ""
    assert re.match(r"\d\d:\d\d:\d\d; island-02/temperature 1[6-9]\d\.\d degC; ", reading)
    page.keyboard.press("+")
    panel.get_by_role("button", name="Live").wait_for()
    page.keyboard.press("Escape")
    panel.get_by_role("button", name="Pause").wait_for()


def test_trend_has_a_scale_for_each_unit(tab: Callable[..., Tab]):
    page = tab().open("page/Picture")
    panel = page.locator(".panel-trend")
    panel.locator("canvas").wait_for()
    assert panel.locator(".u-axis").count() == 3  # time, and two of three units
    wait_for_change(panel.locator(".legend .number").first)
    readings = panel.locator(".legend .number").all_text_contents()
    assert re.fullmatch(r"1\d\d\.\d", readings[0])
    assert re.fullmatch(r"1\.0\d+", readings[1])


def test_curves_that_nobody_sees_are_bounded(tab: Callable[..., Tab]):
    page = tab().open("page/Line")
    kept = page.evaluate("""async () => {
        const { Curves } = await import("./curves.js");
        const curves = new Curves(1, 10);
        for (let at = 0; at < 1000; at += 0.01) curves.add(at, 0, at);
        return curves.size;
    }""")
    assert kept <= 1210


def test_page_loads_again_after_missing_file(tab: Callable[..., Tab]):
    one = tab()
    failed: list[str] = []

    def fail_once(route: Route) -> None:
        if failed:
            route.continue_()
        else:
            failed.append(route.request.url)
            route.abort()

    one.page.route("**/dom.js", fail_once)
    page = one.open("page/Line")
    page.get_by_role("heading", level=1, name="Line").wait_for()
    assert len(failed) == 1
    one.complaints.clear()


def test_graph_shows_stations_and_arrows_of_the_plant(tab: Callable[..., Tab]):
    page = tab().open("page/Plant")
    page.locator(".node").first.wait_for()
    assert sorted(page.locator(".node .name").all_text_contents()) == [
        "island-01",
        "island-02",
        "island-03",
    ]
    labels = page.locator(".link.labelled .label")
    assert labels.count() == 4  # island-03 sends two PDs to island-01
    assert re.search(r"/s", labels.first.text_content() or "")
    page.locator(".node", has_text="island-02").click()
    page.get_by_role("heading", level=1, name="island-02").wait_for()


def test_picture_follows_its_variables(tab: Callable[..., Tab]):
    page = tab().open("page/Picture")
    picture = page.locator(".picture svg")
    wait_for_change(picture.locator("#reading"))
    assert (picture.locator("#reading").text_content() or "").endswith("degC")
    assert picture.locator("#lamp").get_attribute("fill") == "#f5b800"
    assert picture.locator("#off").get_attribute("visibility") == "hidden"
    assert "scale(1 0." in (picture.locator("#level").get_attribute("transform") or "")
    assert "rotate(1" in (picture.locator("#hand").get_attribute("transform") or "")


def test_filter_of_variables_leaves_those_that_fit(tab: Callable[..., Tab]):
    page = tab().open("page/Variables")
    page.get_by_label("Filter").fill("island-02 oven")
    page.get_by_text("Variables: 1").wait_for()
    assert page.locator(".variables tbody tr").count() == 1


def test_viewer_may_not_set_and_sees_why(tab: Callable[..., Tab]):
    page = tab().open("page/Line")
    panel = page.locator(".panel-set", has_text="Setpoint")
    panel.get_by_text("For the role operator; yours is viewer. Log in to set it.").wait_for()
    assert panel.get_by_role("textbox").is_disabled()
    assert panel.get_by_role("button", name="Set", exact=True).is_disabled()


def test_operator_sets_a_set_point_and_logs_out(tab: Callable[..., Tab], plant: Appliance):
    one = tab()
    one.log_in("otto", PASSWORD)
    page = one.page
    panel = page.locator(".panel-set", has_text="Setpoint")
    field = panel.get_by_role("textbox")

    field.fill("101")
    field.press("Enter")
    panel.get_by_text("▲ 0 to 100").wait_for()
    field.fill("75")
    field.press("Enter")
    panel.get_by_text("✓ Set: 75 1/min").wait_for()
    assert plant.values("island-01")["setpoint"] == 75

    panel.get_by_role("button", name="More by 5").click()
    panel.get_by_role("button", name="Set", exact=True).click()
    panel.get_by_text("✓ Set: 80 1/min").wait_for()

    page = one.open("events/")
    page.locator(".panel-events td", has_text="set to 80 1/min by otto").wait_for()
    page.get_by_label("Least severity").select_option("error")
    page.locator(".panel-events td", has_text="by otto").wait_for(state="detached")

    page = one.open("page/Line")
    page.get_by_role("button", name="Log out").click()
    panel.get_by_text("yours is viewer").wait_for()


def test_page_requests_required_comment_and_keeps_it(tab: Callable[..., Tab], plant: Appliance):
    one = tab()
    one.log_in("otto", PASSWORD)
    panel = one.page.locator(".panel-set", has_text="island-03/alarm")
    panel.get_by_role("combobox").select_option("on")
    panel.get_by_role("button", name="Set").click()
    panel.get_by_text("▲ a comment is required").wait_for()
    panel.get_by_label("Comment (required)").fill("door is open")
    panel.get_by_role("button", name="Set").click()
    panel.get_by_text("✓ Set: on").wait_for()
    audit = Path(plant.status()["audit"]["file"]).read_text()
    assert "door is open" in audit
    assert "otto" in audit


def test_refusal_is_shown_in_words_of_the_appliance(tab: Callable[..., Tab]):
    one = tab()
    one.log_in("elsa", PASSWORD)
    page = one.open("variable/island-01/bus0.drive.Controlword")
    panel = page.locator(".panel-set")
    panel.get_by_role("textbox").first.fill("70000")
    panel.get_by_role("button", name="Set").click()
    panel.locator(".result.refused", has_text="■ Refused:").wait_for()
    assert "70000" in panel.locator(".result").inner_text()
    assert all("422" in each for each in one.complaints)  # chromium logs every answer with an error
    one.complaints.clear()


def test_variable_of_the_appliance_cannot_be_set(tab: Callable[..., Tab]):
    one = tab()
    one.log_in("elsa", PASSWORD)
    page = one.open("variable/island-02/left_cpu")
    page.get_by_text("the appliance", exact=True).wait_for()
    assert page.locator(".panel-set").count() == 0


def test_wrong_password_is_refused_in_words(tab: Callable[..., Tab]):
    one = tab()
    page = one.open("login")
    page.get_by_label("User").fill("otto")
    page.get_by_label("Password").fill("wrong")
    page.get_by_role("button", name="Log in").click()
    page.get_by_text("■ Not logged in:").wait_for()
    assert all("401" in each for each in one.complaints)
    one.complaints.clear()


def test_killed_engine_is_an_event_in_words(tab: Callable[..., Tab], plant: Appliance):
    page = tab().open("events/")
    page.locator(".panel-events").wait_for()
    engine = plant.pid("engine")
    os.kill(engine, signal.SIGKILL)
    page.locator(".panel-events td", has_text="engine").first.wait_for()
    plant.wait_for_another("engine", engine)


def test_page_survives_a_restart_of_the_appliance(
    tab: Callable[..., Tab], plant: Appliance, demo: SharedAppliance
):
    one = tab()
    page = one.open("page/Line")
    number = page.locator(".panel-value .number").nth(1)
    wait_for_change(number)
    page.evaluate("window.isSame = true")
    plant.stop()

    page.locator("#banner", has_text="Connection lost").wait_for()
    assert page.locator(".panel-value .tile.stale").count() == 2
    age = page.locator(".panel-value .tile .note").nth(1)
    age.filter(has_text="old: ").wait_for()
    wait_for_change(age)
    panel = page.locator(".panel-set", has_text="Setpoint")
    panel.get_by_text("No connection: nothing can be set.").wait_for()

    wait_for_page(demo.running())
    page.locator("#link.open").wait_for()
    page.locator(".panel-value .tile:not(.stale)").nth(1).wait_for()
    wait_for_change(number)
    assert page.locator("#banner").inner_text() == ""
    assert page.evaluate("window.isSame") is True
    assert all("Failed" in each or "failed" in each for each in one.complaints), one.complaints
    one.complaints.clear()


def test_phone_has_a_menu(tab: Callable[..., Tab]):
    page = tab(viewport={"width": 390, "height": 844}).open("page/Line")
    assert not page.locator("nav").is_visible()
    page.get_by_role("button", name="Menu").click()
    page.locator("nav").get_by_role("link", name="Variables").click()
    page.get_by_role("heading", level=1, name="Variables").wait_for()
    assert not page.locator("nav").is_visible()


def test_dark_scheme_follows_the_system(tab: Callable[..., Tab]):
    ground = "getComputedStyle(document.body).backgroundColor"
    light = tab(color_scheme="light").open("page/Line").evaluate(ground)
    dark = tab(color_scheme="dark").open("page/Line").evaluate(ground)
    assert brightness(dark) < 60
    assert brightness(light) > 190


def brightness(color: str) -> float:
    red, green, blue = map(int, re.findall(r"\d+", color)[:3])
    return (red + green + blue) / 3


def test_language_of_the_browser_and_the_switch(tab: Callable[..., Tab]):
    page = tab(locale="zh-CN").open("events/")
    page.get_by_role("heading", level=1, name="事件").wait_for()
    assert page.evaluate("document.documentElement.lang") == "zh-Hans"
    page.locator("#language").select_option("English")
    page.get_by_role("heading", level=1, name="Events").wait_for()
    page.reload()
    page.get_by_role("heading", level=1, name="Events").wait_for()


def test_keyboard_reaches_the_content_by_the_first_key(tab: Callable[..., Tab]):
    page = tab().open("page/Line")
    page.keyboard.press("Tab")
    assert page.locator("#skip").evaluate("(link) => link === document.activeElement")
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "content"
    page.keyboard.press("Tab")
    outline = "getComputedStyle(document.activeElement).outlineStyle"
    assert page.evaluate(outline) == "solid"


def test_paper_has_the_panels_alone(tab: Callable[..., Tab]):
    page = tab(color_scheme="dark").open("page/Line")
    page.locator(".panel-trend canvas").first.wait_for()
    page.emulate_media(media="print")
    assert not page.locator("nav").is_visible()
    assert not page.get_by_role("button").first.is_visible()
    assert brightness(page.evaluate("getComputedStyle(document.body).backgroundColor")) == 255
    assert len(page.pdf()) > 10_000


def test_table_fits_on_paper_with_the_date_and_its_values_on_phones(tab: Callable[..., Tab]):
    page = tab(viewport={"width": 390, "height": 844}).open("page/Variables")
    value = page.locator(".variables td.number").first.bounding_box()
    assert value is not None
    assert value["x"] + value["width"] < 390
    page.set_viewport_size({"width": 718, "height": 1000})  # A4
    page.emulate_media(media="print")
    assert page.evaluate("document.scrollingElement.scrollWidth") <= 718
    assert page.locator("#clock").is_visible()
    date = page.locator("#clock").get_attribute("data-date") or ""
    assert re.fullmatch(r"20\d\d-\d\d-\d\d", date)


def test_page_of_a_plant_that_does_not_run_says_so(folder: Plants, chromium: Tabs, tmp_path: Path):
    path = folder.write((CONFIG / "solar-line.yaml").read_text(), "asleep.yaml")
    command = [*EAPCTL, "web", str(path), "--listen", "127.9.62.7:8080"]
    environment = os.environ | {"EAP_RUNTIME_DIR": str(tmp_path), "EAP_STATE_DIR": str(tmp_path)}
    server = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
    try:
        assert server.stderr is not None
        assert "http://127.9.62.7:8080/" in server.stderr.readline()
        one = chromium.make("http://127.9.62.7:8080")
        page = one.open("plant/")
        page.get_by_text("No station answers.").wait_for()
        assert one.complaints == []
        one.close()
    finally:
        server.terminate()
        server.communicate()


def test_default_pages_of_the_solar_line(folder: Plants, plant: Appliance, chromium: Tabs):
    plant.stop()  # it has the same addresses
    from playwright.sync_api import expect

    text = (CONFIG / "solar-line.yaml").read_text()
    path = folder.write(f"{text}\nweb: 127.9.62.8:8080\n", "solar-line.yaml")
    line = folder.run(path)
    wait_for_page(line)
    one = chromium.make("http://127.9.62.8:8080")
    page = one.open()
    page.get_by_role("heading", level=1, name="solar-line").wait_for()
    # Until the page knows all stations, it draws senders that it cannot name.
    expect(page.locator(".node")).to_have_count(15)
    assert page.locator(".link").count() == 54
    page.locator("nav").get_by_role("link", name="island-07").click()
    row = page.locator("tr", has_text=re.compile("^temperature"))
    wait_for_change(row.locator("td.number").first)
    page.locator(".panel-routes tbody tr").first.wait_for()
    assert one.complaints == []
    one.close()
    line.stop()
