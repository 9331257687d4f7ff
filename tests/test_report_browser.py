"""The report in a real browser: numbers, keyboard, width, themes, accessibility, speed; no network and no errors."""

from __future__ import annotations

import json
import shutil
import subprocess
import tarfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import report_reader as reader
from micro import micro_run
from report_scripts import MARKS, NAMELESS, SPOILT_LABELS
from results_folder import write_results
from safeswitch.files import load_json
from safeswitch.publish import publish
from safeswitch.report import NAME, write_report
from safeswitch.scoring import read_csv
from safeswitch.scoring.metrics import OTHERS

webdriver = pytest.importorskip("selenium.webdriver")
from selenium.webdriver.common.keys import Keys  # noqa: E402
from selenium.webdriver.support.ui import WebDriverWait  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
AXE = "axe-core@4.14.1"
"""Deque's accessibility checker, from the npm registry, for these tests only."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="needs Debian's chromium and chromium-driver"),
]
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--hide-scrollbars",
    "--host-resolver-rules=MAP * ~NOTFOUND",
)  # fmt: skip


@pytest.fixture(scope="module", params=["made", "committed"])
def page(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page of arbitrary tables, and the page of the committed results."""
    folder = tmp_path_factory.mktemp("report")
    if request.param == "made":
        return write_report(write_results(folder))
    if not (ROOT / "results" / "tables").is_dir():
        pytest.skip("needs the committed results")
    for name in ("leaderboard.csv", "cem_seeds.csv", "manifest.json", "tables", "figures"):
        (folder / name).symlink_to(ROOT / "results" / name)
    return write_report(folder)


@pytest.fixture
def browse(page: Path, open_page: Callable[..., Any]) -> Callable[..., Any]:
    """Opens the page of the test."""
    return partial(open_page, page)


@pytest.fixture
def open_page(tmp_path: Path) -> Iterator[Callable[..., Any]]:
    """Opens a page in a window of a given width; after the test there must be no error and no request."""
    opened = []

    def start(page: Path, width: int = 1280, height: int = 900, dark: bool = False) -> Any:
        options = webdriver.ChromeOptions()
        for flag in (*FLAGS, f"--user-data-dir={tmp_path / str(len(opened))}"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        options.binary_location = str(CHROMIUM)
        driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
        opened.append(driver)
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": scheme})
        driver.get("about:blank")
        driver.get_log("performance")  # what the browser's own first tab asked for is not ours
        driver.get(page.as_uri())
        ready(driver)
        return driver

    yield start
    for driver in opened:
        errors = [entry for entry in driver.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")]
        urls = requests(driver)
        driver.quit()
        assert not errors
        assert all(url.startswith(("file:", "data:", "blob:", "about:")) for url in urls), urls


def ready(driver: Any) -> None:
    WebDriverWait(driver, 30).until(lambda d: d.execute_script("return document.documentElement.dataset.ready"))


def requests(driver: Any) -> list[str]:
    events = [json.loads(entry["message"])["message"] for entry in driver.get_log("performance")]
    return [event["params"]["request"]["url"] for event in events if event["method"] == "Network.requestWillBeSent"]


def choose(driver: Any, **wanted: str) -> None:
    """Choose task, cell, protocol, signal or learner as a user does, by events of the controls."""
    for name, value in wanted.items():
        before = driver.execute_script("return document.documentElement.dataset.task")
        driver.execute_script(
            "const [name, value] = arguments;"
            "const radio = document.querySelector(`input[name=${name}][value='${value}']`);"
            "if (radio) radio.click(); else { $(name).value = value; $(name).dispatchEvent(new Event('change')); }",
            name, value,
        )  # fmt: skip
        if name == "task" and before != value:
            WebDriverWait(driver, 30).until(
                lambda d: d.execute_script("return document.documentElement.dataset.task") == value  # noqa: B023
            )


def numbers(driver: Any) -> dict[str, str]:
    pairs = "[...$('numbers').children].map((box) => [box.dataset.score, box.dataset.value])"
    return driver.execute_script(f"return Object.fromEntries({pairs})")


def test_numbers_at_each_marked_threshold_are_those_of_the_leaderboard(page: Path, browse: Callable[..., Any]) -> None:
    driver, board = browse(), read_csv(page.parent / "leaderboard.csv")
    board["on"] = board["calibrated_on"].astype(object).fillna("") if "calibrated_on" in board else ""
    board["cell"] = board["disturbance"] + "-" + board["severity"].astype(str)
    board = board.set_index(["task", "cell", "protocol", "method", "on"])
    checked = 0
    for task, bundle in reader.tasks_of(page).items():
        choose(driver, task=task)
        for cell, protocol, signal in reader.views(bundle):
            choose(driver, cell=cell, protocol=protocol, signal=signal)
            shown_cell, shown_protocol, found = driver.execute_script(MARKS)
            assert (shown_cell, shown_protocol) == (cell, protocol)
            for mark in found:
                row = board.loc[task, cell, protocol, mark["method"], mark["on"]]
                for name, value in mark["numbers"].items():
                    exact = float("nan") if value is None else value  # JSON has no NaN
                    assert reader.same(float(row[name]), exact), (task, cell, protocol, mark["method"], name, value)
                assert mark["shown"] == f"{row['success']:.4f}"
                assert "the same numbers" in mark["check"], mark
                checked += 1
    assert checked >= 50


def test_a_method_that_stands_twice_is_shown_at_its_own_threshold(page: Path, browse: Callable[..., Any]) -> None:
    driver, board = browse(), read_csv(page.parent / "leaderboard.csv")
    if "calibrated_on" not in board or not (board["calibrated_on"] == OTHERS).any():
        pytest.skip("no method has a threshold from other disturbances")
    twice = "state.marks.filter((mark) => mark.on).map((mark) => mark.method)"
    both = f"return {twice}.filter((name) => state.marks.some((mark) => mark.method === name && !mark.on))"
    for method in driver.execute_script(both):
        driver.execute_script("chooseMethod(arguments[0])", method)
        assert driver.execute_script("return [state.mark.method, state.mark.on]") == [method, ""], method
        labels = driver.execute_script(
            "return [...document.querySelectorAll('.labels .chosen')].map((t) => t.textContent)"
        )
        assert method in labels, "named in the plane, and not by its dagger alone"
    driver.execute_script("chooseView()")
    assert driver.execute_script("return state.mark.on") == "", "as the page opens"


def test_the_keyboard_moves_the_slider_and_everything_follows(browse: Callable[..., Any]) -> None:
    driver = browse()
    slider = driver.find_element("id", "slider")
    slider.send_keys(Keys.HOME)
    low = numbers(driver)
    assert float(low["autonomy"]) < 0.2
    slider.send_keys(Keys.END)
    high = numbers(driver)
    assert float(high["autonomy"]) > float(low["autonomy"])
    assert float(high["false_alarms_before_onset"]) == 0
    end = driver.execute_script("return $('slider').value")
    slider.send_keys(Keys.ARROW_LEFT)
    assert int(driver.execute_script("return $('slider').value")) == int(end) - 1
    failing = driver.execute_script("return state.now.results.filter((result) => result.ok === 0).length")
    assert driver.execute_script("return $('fails').options.length") == failing
    said = WebDriverWait(driver, 5).until(lambda d: d.execute_script("return $('spoken').textContent"))
    assert "success" in said
    assert driver.execute_script("return $('slider').getAttribute('aria-valuetext')")


def test_every_control_can_be_reached_and_named(browse: Callable[..., Any]) -> None:
    driver = browse()
    assert driver.execute_script(NAMELESS) == []
    driver.find_element("css selector", "#plane-chart .points [tabindex='0']").send_keys(Keys.ARROW_RIGHT)
    assert "point 2 of" in driver.execute_script("return document.activeElement.getAttribute('aria-label')")
    assert driver.execute_script("return $('tip').hidden") is False
    method = driver.execute_script("return document.activeElement.getAttribute('aria-label')").split(":")[0]
    driver.switch_to.active_element.send_keys(Keys.ENTER)
    assert driver.execute_script("return state.method") == method


def test_the_table_sorts_by_every_column(browse: Callable[..., Any]) -> None:
    driver = browse()
    driver.execute_script("$('show').value = 'all'; $('show').dispatchEvent(new Event('input'))")
    for index, button in enumerate(driver.find_elements("css selector", "#table thead button")):
        for _ in range(2):
            button.click()
            values, order = driver.execute_script(
                "const key = state.sort.key;"
                "const rows = [...document.querySelectorAll('#table tbody tr')].map((row) =>"
                "  state.board.rows.find((each) => each.method === row.dataset.method && each.on === row.dataset.on));"
                "const th = document.querySelectorAll('#table thead th')[arguments[0]];"
                "const values = rows.map((row) => row[key]).filter((value) => value === value);"
                "return [values, th.getAttribute('aria-sort')];",
                index,
            )
            values = [float(value) if value in ("inf", "-inf") else value for value in values if value is not None]
            assert order in ("ascending", "descending")
            if index:
                assert values == sorted(values, reverse=order == "descending"), button.text


@pytest.mark.parametrize("width", [320, 390, 768, 1280])
def test_no_width_scrolls_sideways(browse: Callable[..., Any], width: int) -> None:
    driver = browse(width=width, height=844)
    assert driver.execute_script("return document.documentElement.scrollWidth") <= width
    edges = "return [...document.querySelectorAll('.chart svg')].map((each) => each.getBoundingClientRect().right)"
    assert max(driver.execute_script(edges)) <= width


@pytest.mark.parametrize("width", [320, 1280])
def test_labels_of_charts_are_whole_and_apart(page: Path, browse: Callable[..., Any], width: int) -> None:
    driver, seen = browse(width=width), 0
    for task in reader.tasks_of(page):
        choose(driver, task=task)
        for signal in driver.execute_script("return [...$('signal').options].map((each) => each.value)"):
            choose(driver, signal=signal)
            for episode in range(0, driver.execute_script("return $('episode').options.length"), 97):
                driver.execute_script("openEpisode($('episode').options[arguments[0]].value, false)", episode)
                assert driver.execute_script(SPOILT_LABELS) == [], (task, signal, episode)
                seen += driver.execute_script("return document.querySelectorAll('.chart text').length")
    assert seen > 100


def test_dark_follows_the_system_and_the_button(browse: Callable[..., Any]) -> None:
    driver = browse(dark=True)
    background = "return getComputedStyle(document.body).backgroundColor"
    dark, pressed = driver.execute_script(background), driver.find_element("id", "theme").get_attribute("aria-pressed")
    assert pressed == "true"
    driver.find_element("id", "theme").click()
    assert driver.find_element("id", "theme").get_attribute("aria-pressed") == "false"
    assert driver.execute_script(background) != dark
    driver.refresh()
    ready(driver)
    assert driver.execute_script("return document.documentElement.dataset.theme") == "light"


def test_an_episode_plays_and_its_failures_open(browse: Callable[..., Any]) -> None:
    driver = browse()
    driver.find_element("id", "slider").send_keys(Keys.END)
    if driver.execute_script("return $('fails').options.length"):
        driver.execute_script("$('fails').selectedIndex = 0; $('fails').dispatchEvent(new Event('change'))")
        assert driver.execute_script("return $('episode').value === $('fails').value")
        assert "fails" in driver.execute_script("return $('story').textContent")
    driver.find_element("id", "play").click()
    WebDriverWait(driver, 10).until(lambda d: d.execute_script("return state.step > 2"))
    assert "s, " in driver.execute_script("return $('clock').textContent")


def test_new_numbers_within_fifty_milliseconds(browse: Callable[..., Any]) -> None:
    driver = browse()
    milliseconds = driver.execute_script("""
      const slow = [];
      for (let value = 0; value <= 1000; value += 8) {
        const started = performance.now();
        $("slider").value = value;
        $("slider").dispatchEvent(new Event("input"));
        document.body.getBoundingClientRect();  // forces style and layout
        slow.push(performance.now() - started);
      }
      return slow.sort((a, b) => a - b);""")
    print(f"slider to numbers: median {milliseconds[len(milliseconds) // 2]:.1f} ms, worst {milliseconds[-1]:.1f} ms")
    assert milliseconds[int(0.95 * len(milliseconds))] <= 50


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a whole run of the micro profile, films included."""
    folder = tmp_path_factory.mktemp("filmed")
    publish(micro_run(folder / "store"), folder / "results")
    return write_report(folder / "results")


@pytest.mark.rendering
def test_a_filmed_episode_plays_beside_its_trace(filmed: Path, open_page: Callable[..., Any]) -> None:
    story = load_json(filmed.parent / "figures" / "cart-pole" / "story.json")
    assert [run["driver"] for run in story["runs"]][0] == "learner" and len(story["runs"]) == 4
    driver = open_page(filmed)
    for index, run in enumerate(story["runs"]):
        driver.find_element("css selector", f"[data-film='film-{index}']").click()
        wait = WebDriverWait(driver, 20)
        wait.until(lambda d: d.execute_script("return $('video').readyState >= 2 && $('video').videoWidth > 0"))
        assert driver.execute_script("return $('video').currentSrc").split("#")[0].endswith(run["file"])
        assert ("succeeds" if run["success"] else "fails") in driver.execute_script("return $('story').textContent")
        driver.execute_script("setTime(state, 10)")
        wait.until(lambda d: not d.execute_script("return $('video').seeking"))
        assert int(driver.execute_script("return $('video').currentTime") * story["fps"]) == 10
    driver.find_element("id", "play").click()
    WebDriverWait(driver, 20).until(lambda d: d.execute_script("return state.step > 14"))
    films = sum(path.stat().st_size for path in (filmed.parent / "figures").rglob("*.mp4"))
    assert films <= 5e6  # of one task: 15 MB in all


@pytest.fixture(scope="session")
def axe(tmp_path_factory: pytest.TempPathFactory) -> str:
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("needs npm to get axe-core")
    folder = tmp_path_factory.mktemp("axe")
    done = subprocess.run([npm, "pack", AXE, "--silent"], cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"npm could not get {AXE}: {done.stderr.strip()[:200]}")
    with tarfile.open(folder / done.stdout.strip().splitlines()[-1]) as archive:
        script = archive.extractfile("package/axe.min.js")
        assert script is not None
        return script.read().decode()


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("width", [320, 1280])
def test_axe_finds_nothing_to_object_to(browse: Callable[..., Any], axe: str, width: int, dark: bool) -> None:
    driver = browse(width=width, dark=dark)
    driver.execute_script(axe)
    report = driver.execute_async_script("axe.run(document, {resultTypes: ['violations']}).then(arguments[0])")
    assert report["passes"] or report["incomplete"] is not None
    assert [(each["id"], [node["html"][:120] for node in each["nodes"][:3]]) for each in report["violations"]] == []


def test_one_file_is_all_there_is(page: Path) -> None:
    assert page.name == NAME
    assert page.stat().st_size <= 5e6
