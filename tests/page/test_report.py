"""A run's report in a real browser: it needs nothing from outside, fits, and its plots share cursor and time."""

import csv
import io
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pypdfium2 as pdfium
import pytest
from PIL import Image
from playwright.sync_api import Browser

from groundstation.analysis.measures import MEASURES
from groundstation.palette import colour
from groundstation.report.compare_report import write as write_comparison
from groundstation.report.report import evaluated, write_report
from groundstation.report.report import write_comparison as write_runs
from groundstation.report.run_comparison import ComparedRun
from shoal.config.loader import check
from shoal.messages.messages import Mode
from sim_bridge.studies.campaign import Campaign
from sim_bridge.studies.dependence import dependences
from sim_bridge.studies.report import write_report as write_campaign
from tests.groundstation.report.comparisons import comparison, variant
from tests.groundstation.synthetic import Script, write_run
from tests.page.flights import serious

pytestmark = [pytest.mark.timeout(120), pytest.mark.real_time]

LAWS = comparison(variant("nmpc", 1.0), variant("ownlaw:Pd", 3.0), variant("nmpc-leader-follower", 20.0))
CAMPAIGN = {
    "name": "mini", "experiment": "pool", "seeds": 6, "sweep": {"sim.plant.mass_error": [0.0, 0.1]},
    "draw": {"sim.plant.current_mps": {"uniform": [[-0.01, 0.0, 0.0], [0.01, 0.0, 0.0]]}},
}  # fmt: skip
HINTS = r"(?i)\b(drag|click|wheel|Esc)\b"  # what nobody can do on paper
CHARTS = "document.querySelectorAll('.uplot').length"
TOO_WIDE = "[...document.querySelectorAll('main, .card, figure')].filter((e) => e.scrollWidth > e.clientWidth + 1).length"
NOTE_PRINTED = """matchMedia("print").addEventListener("change", ({ matches }) => {
  if (matches) window.printedPx = document.documentElement.clientWidth;
})"""  # a browser lays out what is too wide on a wider page, shrinks that, and cuts the rest
NOTE_TEXTS = """window.drawn = [];
const pen = CanvasRenderingContext2D.prototype, fill = pen.fillText;
pen.fillText = function (text, ...where) { drawn.push(text); fill.call(this, text, ...where); };"""
TIMES = "[...document.querySelectorAll('#tracking .u-legend tr:first-child .u-value')].map((e) => e.textContent)"


def test_a_broken_runs_report_zooms_together_and_requests_nothing(browser: Browser, tmp_path: Path) -> None:
    def mode(_: int, at_s: float) -> tuple[Mode, str]:
        return (Mode.FAULT, "no pose") if at_s > 8.0 else (Mode.TRACKING, "")

    write_run(tmp_path, Script(until_s=9.0, mode=mode))
    write_report(tmp_path)
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    trouble: list[str] = []
    page.on("pageerror", lambda error: trouble.append(str(error)))
    page.on("request", lambda request: None if request.url.startswith(("file:", "data:")) else trouble.append(request.url))
    page.add_init_script(NOTE_TEXTS)
    page.goto(f"file://{tmp_path / 'report.html'}")
    assert "no pose" in page.locator(".cause").inner_text()
    page.locator("figure.plot", has_text="Modes and faults").scroll_into_view_if_needed()
    page.wait_for_function("drawn.includes('robot 1') && drawn.includes('robot 2')")  # of each row of bars, whose it is
    page.locator("#tracking").scroll_into_view_if_needed()
    page.wait_for_function(f"{CHARTS} >= 3")
    axis = page.locator("#tracking .u-over")
    box = axis.nth(0).bounding_box()
    assert box is not None
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.5 * box["width"], y)
    page.wait_for_function(f"new Set({TIMES}).size === 1 && {TIMES}[0] !== '–'")  # one cursor for all panels
    page.mouse.down()
    page.mouse.move(box["x"] + 0.75 * box["width"], y, steps=4)
    page.mouse.up()
    page.wait_for_function("document.body.classList.contains('zoomed')")
    page.mouse.move(box["x"] + 2, y)
    page.wait_for_function(f"{TIMES}.every((t) => parseFloat(t) > 3 && parseFloat(t) < 6)")  # they begin where the drag began
    page.keyboard.press("Escape")
    page.wait_for_function("!document.body.classList.contains('zoomed')")
    assert page.evaluate(TOO_WIDE) == 0
    assert serious(page) == []
    page.evaluate(NOTE_PRINTED)
    page.pdf(format="A4")
    assert page.evaluate("printedPx") < 700  # A4 within its margins: nothing is cut
    page.emulate_media(media="print")
    assert not re.search(HINTS, page.locator("main").inner_text())
    assert trouble == []
    page.close()


def test_every_figure_and_table_of_a_report_is_saved_for_a_paper(browser: Browser, tmp_path: Path) -> None:
    def mode(_: int, at_s: float) -> tuple[Mode, str]:
        return (Mode.FAULT, "no pose") if at_s > 8.0 else (Mode.TRACKING, "")

    write_run(tmp_path, Script(until_s=9.0, mode=mode))
    write_report(tmp_path)
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto(f"file://{tmp_path / 'report.html'}")

    def saved(label: str, what: str) -> tuple[str, bytes]:
        menu = page.get_by_label(label, exact=True).first
        menu.scroll_into_view_if_needed()
        with page.expect_download() as download:
            menu.select_option(what)
        return download.value.suggested_filename, download.value.path().read_bytes()

    page.locator("#tracking").scroll_into_view_if_needed()
    name, svg = saved("Save the figure tracking", "svg-1")
    drawn = ElementTree.fromstring(svg)
    assert name == "tracking-1col.svg" and drawn.get("width") == "252pt"
    texts = [node.text for node in drawn.iter("{http://www.w3.org/2000/svg}text")]
    assert "time since the start [s]" in texts and any(text and "[mm]" in text for text in texts)
    assert "fault noticed" in texts and "20 s" not in texts, "each line across the figure is explained, and no other"
    for label in ("tracking", "paths", "timeline"):  # curves, a picture that matplotlib drew, and bars
        page.locator(f"#{label}").scroll_into_view_if_needed()
        name, pdf = saved(f"Save the figure {label}", "pdf-2")
        opened = pdfium.PdfDocument(pdf)
        assert len(opened) == 1 and opened[0].get_width() == 520
        assert len(list(opened[0].get_objects())) > 10
        assert any(unit in opened[0].get_textpage().get_text_range() for unit in ("[s]", "[m]"))
    _, png = saved("Save the figure tracking", "png-1")
    assert png[:4] == b"\x89PNG" and int.from_bytes(png[16:20]) == 2100  # 3.5 in at 600 dpi
    image = Image.open(io.BytesIO(png))
    assert image.info["dpi"] == pytest.approx((600, 600), abs=0.1), "a program that places it knows how wide it is"
    image.load()  # and every part of it has its checksum
    _, data = saved("Save the figure tracking", "csv")
    assert {"0.05", "0.1", "0.15"} <= {row[0] for row in csv.reader(data.decode().splitlines())}, "no digits that are none"
    name, table = saved("Save the table errors", "csv")
    rows = list(csv.reader(table.decode().splitlines()))
    assert len({len(row) for row in rows}) == 1 and rows[2][0] == "robot 1"
    name, table = saved("Save the table errors", "tex")
    assert b"\\begin{tabular}{l" in table and b"\\multicolumn" in table
    assert table.startswith(b"% \\usepackage{booktabs}\n") and table.count(b"\\\\") == len(rows)
    _, table = saved("Save the table requirements", "tex")
    assert b"$\\checkmark$" in table and table.startswith(b"% \\usepackage{booktabs,amssymb}\n"), "all that the table needs"
    page.close()


COLUMN_PT = {1: 252, 2: 520}
LEAST_PT = 6.0  # what a reader of a paper can read
BOXES = """() => {
  const svg = document.querySelector("svg"), whole = svg.getBoundingClientRect(), by = svg.viewBox.baseVal.width / whole.width;
  const { left: x, top: y } = whole, places = ({ left, top, right, bottom }) => [left - x, top - y, right - x, bottom - y];
  return [...svg.querySelectorAll("text, path")].map((e) => places(e.getBoundingClientRect()).map((v) => v * by));
}"""


def test_figures_of_every_page_are_saved_whole_and_readable_at_one_and_two_columns(browser: Browser, tmp_path: Path) -> None:
    """Reports, laws and runs compared, and campaigns: texts are large enough, nothing lies outside, each axis has its unit."""
    names = []
    for page_file in pages_with_figures(tmp_path):
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(f"file://{page_file}")
        for figure in page.locator("figure").all():
            figure.scroll_into_view_if_needed()
            menu = figure.get_by_label("Save the figure").or_(figure.locator(".save-as")).first
            for columns, width_pt in COLUMN_PT.items():
                with page.expect_download() as download:
                    menu.select_option(f"svg-{columns}")
                names.append(f"{page_file.parent.name}/{download.value.suggested_filename}")
                assert_complete(browser, download.value.path().read_text(encoding="utf-8"), width_pt, names[-1])
            page.evaluate("document.body.click()")
        page.close()
    assert len(set(names)) == len(names), "each figure is saved under a name of its own"
    assert [name for name in names if not re.fullmatch(r"\w+/[\w-]+\.svg", name)] == [], "LaTeX takes them"


def pages_with_figures(folder: Path) -> list[Path]:
    """A page of each kind that has figures for a paper."""
    for name in ("run", "laws", "campaign", "runs"):
        (folder / name).mkdir()
    write_run(folder / "run", Script(until_s=9.0))
    write_report(folder / "run")
    (folder / "laws" / "comparison.json").write_text(LAWS.to_json())
    write_comparison(folder / "laws")
    campaign = check(Campaign, CAMPAIGN, "mini.toml")
    fixed = {"status": "flown", "passed": True, "reason": "", "commit": "0123", "wall_s": 1.0}
    rows: list[dict[str, Any]] = [
        {**dict.fromkeys(MEASURES, 0.01 * k), **fixed, "index": k, "seed": k, "at_fault": 0.0}
        | {"sim.plant.mass_error": 0.1 * (k % 2), "sim.plant.current_mps": [1e-3 * k, 0.0, 0.0]}
        for k in range(1, 7)
    ]
    write_campaign(campaign, rows, dependences(campaign, rows), 6, folder / "campaign" / "report.html")
    series, _, result = evaluated(folder / "run")
    compared = [ComparedRun(name, series, result) for name in ("first", "second")]
    write_runs(compared, folder / "runs" / "why.html")
    files = ("run/report.html", "laws/comparison.html", "campaign/report.html", "runs/why.html")
    return [folder / file for file in files]


def assert_complete(browser: Browser, svg: str, width_pt: int, name: str) -> None:
    drawn = ElementTree.fromstring(svg)
    width, height = (float(drawn.get(key, "").removesuffix("pt")) for key in ("width", "height"))
    texts = list(drawn.iter("{http://www.w3.org/2000/svg}text"))
    assert width == width_pt and min(float(text.get("font-size", 0)) for text in texts) >= LEAST_PT, name
    labels = [text.text or "" for text in texts if "[" in (text.text or "")]
    assert labels and not any(re.match(r"robot \d+ \[|\d+–\d+ \[", label) for label in labels), name  # a quantity, not whose
    page = browser.new_page()
    page.set_content(svg)
    for left, top, right, bottom in page.evaluate(BOXES):
        assert left > -1.0 and top > -1.0 and right < width + 1.0 and bottom < height + 1.0, name
    page.close()


def test_figures_of_a_comparison_are_saved_as_they_are_drawn(browser: Browser, tmp_path: Path) -> None:
    """A logarithmic axis keeps its numbers whole, dots keep their laws' colours, names end where their axes begin."""
    (tmp_path / "comparison.json").write_text(LAWS.to_json())
    write_comparison(tmp_path)
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto(f"file://{tmp_path / 'comparison.html'}")
    assert page.evaluate(TOO_WIDE) == 0

    def saved(what: str) -> bytes:
        menu = page.get_by_label("Save the figure errors", exact=True)
        menu.scroll_into_view_if_needed()
        with page.expect_download() as download:
            menu.select_option(what)
        return download.value.path().read_bytes()

    drawn = ElementTree.fromstring(saved("svg-1"))
    numbers = [
        node.text for node in drawn.iter("{http://www.w3.org/2000/svg}text") if node.text is not None and node.text.isdigit()
    ]
    assert numbers and all(len(number) > 1 or number == "1" for number in numbers), numbers
    dots = [node for node in drawn.iter("{http://www.w3.org/2000/svg}path") if node.get("opacity") == "0.4"]
    assert {dot.get("fill") for dot in dots} == {colour(i).lower() for i in range(len(LAWS.variants))}
    text = pdfium.PdfDocument(saved("pdf-2"))[0].get_textpage()
    ends = []
    for law in LAWS.variants:
        place = text.search(law.name).get_next()
        assert place is not None
        ends.append(text.get_charbox(place[0] + len(law.name) - 1)[2])
    assert max(ends) - min(ends) < 2.0  # points
    page.close()
