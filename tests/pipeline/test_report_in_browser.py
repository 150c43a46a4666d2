"""The report in a real browser, without a screen."""

import re
import shutil
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from tests.pipeline.stages.report.test_stage import finished, write

playwright = pytest.importorskip(
    "playwright.sync_api", reason="playwright is not installed"
)
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here"),
]
A4_PX = {"width": 794, "height": 1123}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A report as the stage leaves it."""
    place = tmp_path_factory.mktemp("report")
    write(finished(place / "root"), place / "out")
    return place / "out"


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as browsers:
        flags = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]
        started = browsers.chromium.launch(executable_path=CHROMIUM, args=flags)
        yield started
        started.close()


@pytest.fixture
def page(browser, folder):
    """The report, open; whatever the browser complains of fails the test."""
    faults = []
    context = browser.new_context(viewport={"width": 1200, "height": 800})
    opened = context.new_page()
    opened.on("pageerror", lambda error: faults.append(str(error)))
    opened.on(
        "console",
        lambda said: (
            faults.append(said.text) if said.type in ("error", "warning") else None
        ),
    )
    opened.on("requestfailed", lambda asked: faults.append(f"failed: {asked.url}"))
    opened.on(
        "request",
        lambda asked: None if asked.url.startswith("file:") else faults.append(asked.url),
    )
    opened.goto((folder / "report.html").as_uri())
    yield opened
    context.close()
    assert faults == []


def test_every_figure_is_drawn(page):
    boxes = page.eval_on_selector_all(
        "figure > svg",
        """all => all.map(svg => {
             const box = svg.getBoundingClientRect();
             return [svg.querySelector('title').textContent, box.width, box.height,
                     svg.querySelectorAll('path, circle').length];
           })""",
    )

    assert len(boxes) > 20
    for title, width, height, marks in boxes:
        assert width > 100, title
        assert height > 100, title
        assert marks > 3, title


def test_every_link_is_alive_and_leads_to_a_page_without_errors(page, folder):
    links = page.eval_on_selector_all("a", "all => all.map(a => a.href)")

    assert len(links) == 4
    for link in links:
        file = Path(unquote(urlsplit(link).path))
        assert file.is_file(), link
        assert file.is_relative_to(folder)
        page.goto(link)
        assert page.title()


def test_machines_and_times_are_shown_within(page):
    inner = page.frame_locator("iframe")

    assert inner.locator("table").count() == 3
    assert "node<7>" in inner.locator("body").inner_text()


def test_nothing_is_wider_than_a_phone_but_what_scrolls(page):
    page.set_viewport_size({"width": 390, "height": 800})

    assert page.evaluate("document.documentElement.scrollWidth") <= 390


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_words_stand_out_from_the_ground(page, scheme):
    page.emulate_media(color_scheme=scheme)
    ground, ink = page.evaluate(
        """() => { const style = getComputedStyle(document.body);
             return [style.backgroundColor, style.color]; }"""
    )

    levels = [sum(map(int, re.findall(r"\d+", colour)[:3])) / 3 for colour in (ground, ink)]
    assert abs(levels[0] - levels[1]) > 150
    assert (levels[0] > levels[1]) == (scheme == "light")


def test_it_prints_to_pages_none_of_which_cuts_a_table_or_figure_off(page):
    page.emulate_media(media="print")
    page.set_viewport_size(A4_PX)
    widest = page.eval_on_selector_all(
        "figure svg, table",
        "all => Math.max(...all.map(x => x.getBoundingClientRect().right))",
    )
    document = page.pdf(format="A4")

    assert document.startswith(b"%PDF-")
    assert len(re.findall(rb"/Type\s*/Page\b", document)) > 3
    assert widest <= A4_PX["width"]
