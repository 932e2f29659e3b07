"""The page in a real browser: it sorts, filters, switches, fetches nothing, complains of nothing, and fits a phone."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator

import pytest

from covis.evaluation.report import write_report

from .conftest import write_run

selenium = pytest.importorskip("selenium", reason="needs selenium (pip install covis[dev])")
from selenium import webdriver  # noqa: E402
from selenium.webdriver.chrome.service import Service  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.support.ui import Select  # noqa: E402

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
DRIVER = shutil.which("chromedriver")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
)

pytestmark = pytest.mark.skipif(
    not (CHROMIUM and DRIVER), reason="needs Chromium and its driver (apt-get install chromium chromium-driver)"
)


@pytest.fixture(scope="module")
def browser() -> Iterator[webdriver.Chrome]:
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    with tempfile.TemporaryDirectory() as profile:
        for flag in (*FLAGS, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        driver = webdriver.Chrome(options=options, service=Service(DRIVER))
        yield driver
        driver.quit()


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_report(write_run(tmp_path_factory.mktemp("run"))).html.as_uri()


@pytest.fixture
def page(browser: webdriver.Chrome, address: str) -> webdriver.Chrome:
    size(browser, 1280)
    browser.get(address)
    return browser


def size(browser: webdriver.Chrome, width: int) -> None:
    metrics = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)


def shown(page: webdriver.Chrome, selector: str) -> list:
    return [e for e in page.find_elements(By.CSS_SELECTOR, selector) if e.is_displayed()]


def column(page: webdriver.Chrome, table: int, number: int) -> list[str]:
    rows = page.find_elements(By.CSS_SELECTOR, "table.sortable")[table].find_elements(By.CSS_SELECTOR, "tbody tr")
    return [row.find_elements(By.CSS_SELECTOR, "th, td")[number].text for row in rows]


def test_headers_sort_and_say_so(page):
    table = page.find_elements(By.CSS_SELECTOR, "table.sortable")[1]
    headers = table.find_elements(By.CSS_SELECTOR, "thead th")
    assert column(page, 1, 1) == sorted(column(page, 1, 1), reverse=True)
    button = headers[1].find_element(By.TAG_NAME, "button")
    button.click()
    assert headers[1].get_attribute("aria-sort") == "descending"
    button.click()
    assert headers[1].get_attribute("aria-sort") == "ascending"
    assert column(page, 1, 1) == sorted(column(page, 1, 1))
    headers[0].find_element(By.TAG_NAME, "button").click()
    assert column(page, 1, 0) == ["<b>bold</b>", "good", "random"]
    assert headers[1].get_attribute("aria-sort") is None


def test_the_filter_leaves_methods_with_the_text(page):
    assert len(shown(page, "tbody tr[data-m]")) == 9  # at a glance, and two targets
    page.find_element(By.ID, "filter").send_keys("BOLD")
    assert {row.find_element(By.TAG_NAME, "th").text for row in shown(page, "tbody tr[data-m]")} == {"<b>bold</b>"}
    assert len(shown(page, ".chip")) == 1


def test_a_target_is_picked_everywhere(page):
    Select(page.find_element(By.ID, "target")).select_by_index(2)
    assert [e.text for e in shown(page, "#leaderboard article.target h3")] == ['a "quoted" <i>target</i>']
    assert len(shown(page, "#precision-recall figure")) == 1
    Select(page.find_element(By.ID, "target")).select_by_index(0)
    assert len(shown(page, "#precision-recall figure")) == 2


def test_methods_switch_off_and_on(page):
    chip = next(c for c in page.find_elements(By.CSS_SELECTOR, ".chip") if c.text == "good")
    number = chip.get_attribute("data-chip")
    lines = f'#precision-recall g[data-m="{number}"]'
    assert len(shown(page, lines)) > 0
    chip.click()
    assert chip.get_attribute("aria-pressed") == "false"
    assert shown(page, lines) == []
    assert "good" not in [row.find_element(By.TAG_NAME, "th").text for row in shown(page, "tbody tr[data-m]")]
    chip.click()
    assert len(shown(page, lines)) > 0


def test_failures_show_the_matches_of_the_method_picked(page):
    def drawn() -> list[str | None]:
        picture = page.find_element(By.CSS_SELECTOR, "#failures svg.picture")
        groups = picture.find_elements(By.CSS_SELECTOR, "g[data-pick]")
        return [g.get_attribute("data-pick") for g in groups if g.value_of_css_property("display") != "none"]

    select = Select(page.find_element(By.CSS_SELECTOR, "#failures select"))
    for name in ("good", "random"):
        select.select_by_visible_text(name)
        assert drawn() == [select.first_selected_option.get_attribute("value")]


def test_images_are_there(page):
    loaded = page.execute_async_script(
        """const done = arguments[0], image = new Image();
        image.onload = () => done(image.naturalWidth);
        image.onerror = () => done(0);
        image.src = document.querySelector("svg.images image").getAttribute("href");"""
    )
    assert loaded == 1


def test_nothing_is_fetched_and_nothing_complained_of(browser, address):
    browser.get("about:blank")
    browser.get_log("performance"), browser.get_log("browser")
    browser.get(address)
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    assert [url for url in asked if not url.startswith("data:")] == [address]
    assert browser.get_log("browser") == []


@pytest.mark.parametrize("width", [320, 390, 768, 1280])
def test_the_page_never_scrolls_sideways(page, width):
    size(page, width)
    assert page.execute_script("return document.documentElement.scrollWidth") <= width
    assert page.execute_script("return document.querySelector('.scroll').scrollWidth") > 0


def test_it_reads_in_the_dark(page):
    def background() -> str:
        return page.find_element(By.TAG_NAME, "body").value_of_css_property("background-color")

    light = background()
    dark = {"features": [{"name": "prefers-color-scheme", "value": "dark"}]}
    page.execute_cdp_cmd("Emulation.setEmulatedMedia", dark)
    try:
        assert background() != light
    finally:
        page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
