"""The pages in a real browser, opened as files: nothing fetched, nothing wrong on the console,
everything works.
"""

from __future__ import annotations

import base64
import json
import subprocess
import tarfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from safevar_sumo.api.simulation import simulate
from safevar_sumo.questions.case import Results
from safevar_sumo.replay.animation import PLAYER_FOLDER, animate
from safevar_sumo.replay.comparison import comparison_of
from safevar_sumo.report.page import TEMPLATE_FOLDER
from safevar_sumo.study.file import study_names
from tests.support.in_process import SLOW
from tests.support.needs import need_library, need_program
from tests.support.sheets import sheet_of_shipped

if TYPE_CHECKING:
    from selenium.webdriver import Chrome
    from selenium.webdriver.remote.webelement import WebElement

webdriver = need_library("selenium.webdriver")
By = need_library("selenium.webdriver.common.by").By
Keys = need_library("selenium.webdriver.common.keys").Keys

A4 = {"width": round(190 / 25.4 * 96), "height": round(279 / 25.4 * 96)}
"""The part of a page within its margins [px]."""
TOO_WIDE = """return [...document.querySelectorAll(".wide")]
    .filter((one) => one.scrollWidth > one.clientWidth + 1
        || one.getBoundingClientRect().right > innerWidth)
    .map((one) => one.getAttribute("aria-label"))"""
"""The tables that reach into what is beside them, or beyond the page."""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chrome]:
    """A browser with a profile of its own, that takes down what its pages say and ask for."""
    options = webdriver.ChromeOptions()
    options.binary_location = need_program(
        "chromium", "chromium-browser", "google-chrome"
    )
    for one in (*OPTIONS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(one)
    options.set_capability(
        "goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"}
    )
    result = webdriver.Chrome(
        options=options, service=webdriver.ChromeService(need_program("chromedriver"))
    )
    yield result
    result.quit()


@pytest.fixture(scope="module")
def report(page: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("page") / "report.html"
    file.write_text(page, encoding="utf-8")
    return file


def opened(browser: Chrome, page: Path) -> None:
    browser.get("about:blank")
    browser.get_log("browser")
    browser.get_log("performance")
    browser.get(page.as_uri())
    browser.execute_script(
        "document.querySelectorAll('details.section').forEach((one) => { one.open = true; })"
    )


def unfold(browser: Chrome, is_open: str) -> None:
    """Open or close all that is folded."""
    browser.execute_script(
        f"document.querySelectorAll('details').forEach((one) => {{ one.open = {is_open}; }})"
    )


def said_by(browser: Chrome) -> list[str]:
    """What stands on the console."""
    return [entry["message"] for entry in browser.get_log("browser")]


def requests_of(browser: Chrome) -> list[str]:
    messages = [
        json.loads(entry["message"])["message"]
        for entry in browser.get_log("performance")
    ]
    return [
        one["params"]["request"]["url"]
        for one in messages
        if one["method"] == "Network.requestWillBeSent"
    ]


PICTURE, SLIDER, PLAY = ".animation img", ".anim-slider", "[title=Play]"


def try_player(browser: Chrome, player: WebElement) -> None:
    """Play it, pause it, scrub it."""
    picture, slider, play = (
        player.find_element(By.CSS_SELECTOR, one) for one in (PICTURE, SLIDER, PLAY)
    )
    browser.execute_script(
        "arguments[0].value = 0; arguments[0].dispatchEvent(new Event('input'))", slider
    )
    start = picture.get_attribute("src")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", play)
    play.click()
    time.sleep(0.6)
    player.find_element(By.CSS_SELECTOR, "[title=Pause]").click()
    assert 0 < int(slider.get_attribute("value")) < int(slider.get_attribute("max"))
    assert picture.get_attribute("src") != start
    assert "collides at" in picture.get_attribute("alt")


@SLOW
def test_an_animation_plays_and_scrubs_as_a_file(
    browser: Chrome, case: Results, tmp_path: Path
) -> None:
    settings = case.solutions[list(case.characteristics.names)]
    simulation = simulate(case.study, settings.iloc[0])
    animate(comparison_of(simulation), tmp_path / "it.html")
    opened(browser, tmp_path / "it.html")
    try_player(browser, browser.find_element(By.CSS_SELECTOR, ".animation"))
    assert said_by(browser) == []
    assert {url for url in requests_of(browser) if not url.startswith("data:")} == {
        (tmp_path / "it.html").as_uri()
    }


@SLOW
def test_nothing_leaves_the_page_and_nothing_is_wrong_with_it(
    browser: Chrome, report: Path
) -> None:
    opened(browser, report)
    unfold(browser, "true")
    time.sleep(0.5)
    assert said_by(browser) == []
    assert {url.partition(":")[0] for url in requests_of(browser)} <= {"file", "data"}
    assert [url for url in requests_of(browser) if url.startswith("file:")] in (
        [],
        [report.as_uri()],
    )
    broken = "return [...document.images].filter((one) => one.complete && !one.naturalWidth).length"
    assert browser.execute_script(broken) == 0


@SLOW
def test_the_keyboard_opens_a_replay_and_plays(browser: Chrome, report: Path) -> None:
    opened(browser, report)
    unfold(browser, "false")
    replay = browser.find_element(By.CSS_SELECTOR, "details.replay")
    replay.find_element(By.TAG_NAME, "summary").send_keys(Keys.ENTER)
    assert replay.get_attribute("open") is not None
    slider = replay.find_element(By.CSS_SELECTOR, SLIDER)
    before = int(slider.get_attribute("value"))
    slider.send_keys(Keys.ARROW_LEFT)
    assert int(slider.get_attribute("value")) == before - 1
    try_player(browser, replay)


@SLOW
@pytest.mark.parametrize(("width", "scheme"), [(390, "light"), (1400, "dark")])
def test_it_fits_the_screen_and_everybody_can_read_it(
    width: int, scheme: str, browser: Chrome, report: Path, axe: str
) -> None:
    resized(browser, width, scheme)
    try:
        opened(browser, report)
        assert (
            browser.execute_script("return document.documentElement.scrollWidth")
            <= width
        )
        unfold(browser, "true")
        assert (
            browser.execute_script("return document.documentElement.scrollWidth")
            <= width
        )
        assert violations(browser, axe) == []
    finally:
        resized(browser, 1400)


@pytest.fixture(scope="module")
def axe(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The script of axe-core, from npm's registry."""
    folder = tmp_path_factory.mktemp("axe")
    subprocess.run(
        [need_program("npm"), "pack", AXE, "--silent"], check=True, cwd=folder
    )
    with tarfile.open(next(folder.glob("axe-core-*.tgz"))) as archive:
        return archive.extractfile("package/axe.min.js").read().decode()


BROKEN_NAMES = """
    const text = document.createRange();
    const lines = (cell) => { text.selectNodeContents(cell); return text.getClientRects().length; };
    const names = [...document.querySelectorAll("td.label")]
        .filter((cell) => !/\\s/.test(cell.textContent.trim()));
    return names.filter((cell) => lines(cell) > 1).map((cell) => cell.textContent);
"""
"""Labels of one word that are on several lines."""


@SLOW
def test_it_prints_on_few_pages_what_is_unfolded_and_nothing_to_press(
    browser: Chrome, report: Path
) -> None:
    opened(browser, report)
    printed = base64.b64decode(
        browser.execute_cdp_cmd("Page.printToPDF", {"printBackground": True})["data"]
    )
    assert printed.startswith(b"%PDF")
    assert 3 <= printed.count(b"/Type /Page\n") <= 8
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    browser.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        A4 | {"deviceScaleFactor": 1, "mobile": False},
    )
    try:
        assert browser.execute_script(TOO_WIDE) == []
        assert browser.execute_script(BROKEN_NAMES) == []
        height = (
            "return document.querySelector(arguments[0]).getBoundingClientRect().height"
        )
        for part in (".front", ".sheet"):
            assert browser.execute_script(height, part) <= A4["height"], (
                f"{part} is one page"
            )
        seen = (
            "return [...document.querySelectorAll(arguments[0])].filter((one) =>"
            " one.checkVisibility()).length"
        )
        assert browser.execute_script(seen, ".anim-controls") == 0
        assert browser.execute_script(seen, ".animation") == 1, (
            "a still of the first replay"
        )
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})


@SLOW
@pytest.mark.parametrize("name", study_names())
def test_each_shipped_study_has_its_sheet_on_one_page(
    name: str, browser: Chrome, tmp_path: Path
) -> None:
    files = PLAYER_FOLDER / "player.css", TEMPLATE_FOLDER / "report.css"
    css = "".join(file.read_text(encoding="utf-8") for file in files)
    sheet = sheet_of_shipped(name)
    assert "Name and signature" in sheet
    page = tmp_path / "sheet.html"
    body = f"<style>{css}</style><main><h1>Safety report: {name}</h1>{sheet}</main>"
    page.write_text(f"<!DOCTYPE html><meta charset=utf-8>{body}", encoding="utf-8")
    browser.get(page.as_uri())
    options = {"printBackground": True, "preferCSSPageSize": True}
    pdf = base64.b64decode(browser.execute_cdp_cmd("Page.printToPDF", options)["data"])
    (tmp_path / "sheet.pdf").write_bytes(pdf)
    assert pdf.count(b"/Type /Page\n") == 1


@SLOW
def test_without_javascript_it_stands_still_and_tells_the_same(
    browser: Chrome, report: Path
) -> None:
    browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
    try:
        opened(browser, report)
        assert "limits" in browser.find_element(By.CSS_SELECTOR, ".front").text
        still = browser.find_element(By.CSS_SELECTOR, PICTURE)
        assert "collides at" in still.get_attribute("alt")
        assert still.get_property("naturalWidth") > 100
    finally:
        browser.execute_cdp_cmd(
            "Emulation.setScriptExecutionDisabled", {"value": False}
        )


AXE = "axe-core@4.10.3"
OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--window-size=1400,900",
)


def resized(browser: Chrome, width: int, scheme: str = "light") -> None:
    """Make it a screen of that width, in light or dark."""
    browser.execute_cdp_cmd(
        "Emulation.setEmulatedMedia",
        {"features": [{"name": "prefers-color-scheme", "value": scheme}]},
    )
    browser.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500},
    )


def violations(browser: Chrome, axe: str) -> list[dict[str, Any]]:
    """What axe-core finds in the page that is serious or critical."""
    browser.execute_script(axe)
    result = browser.execute_async_script(
        "const done = arguments[0]; axe.run(document).then((found) => done(found.violations));"
    )
    return [
        {"rule": one["id"], "where": [node["html"][:150] for node in one["nodes"][:3]]}
        for one in result
        if one["impact"] in ("serious", "critical")
    ]
