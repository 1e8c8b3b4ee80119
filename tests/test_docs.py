"""Generated pages are current, and no page points at a file that is not there."""

import re
from pathlib import Path

import pytest

from shoal.config import key_reference
from tools import pages, readers

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
MANUAL = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])  # below it, pages are generated
WORDS = 2500  # a page of the manual, tables without their bars
HISTORY = re.compile(
    r"\b(?:was|were) once\b|\buntil now\b|\btried and\b|\bcame to \d|\bin turns beside\b"
    r"|\d[^.|]{0,40} before(?:,| and [\d.]+)[^.|]{0,40} now\b|\bis [\d.]+(?: \w+)? now\b"
)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def _anchor(heading: str) -> str:
    """A heading's anchor as GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower()).replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_headings(page: Path) -> None:
    for target, anchor in re.findall(r"\]\(([^)#\s]*\.md|)#([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if "://" not in target:
            linked = page.parent / target if target else page
            headings = re.findall(r"^#+ (.*)$", linked.read_text(encoding="utf-8"), flags=re.MULTILINE)
            assert anchor in map(_anchor, headings), f"{page.name} links to {target}#{anchor}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_files_named_in_text_exist(page: Path) -> None:
    """`package/file.py` in backquotes is a promise; files get renamed."""
    packages = "shoal|localizer|robot_agent|groundstation|sim_bridge|tests|benchmarks|docs|tools"
    for name in re.findall(rf"`((?:{packages})/[\w./-]*\.\w+)`", page.read_text(encoding="utf-8")):
        assert (ROOT / name).exists(), f"{page.name} names {name}"


@pytest.mark.parametrize("page", MANUAL, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_of_the_manual_is_short_and_tells_no_history(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert sum(bool(word.strip("|-:")) for word in text.split()) <= WORDS
    match = HISTORY.search(text.replace("\n", " "))
    assert not match, f"{match[0]!r}: what was belongs into the commit"


def test_the_list_of_pages_names_each() -> None:
    listed = re.findall(r"\]\(([\w-]+\.md)\)", (ROOT / "docs" / "README.md").read_text(encoding="utf-8"))
    assert {page.name for page in (ROOT / "docs").glob("*.md")} - {"README.md"} == {*listed}


def test_generated_pages_are_current() -> None:
    written = pages.files()
    for path, text in written.items():
        assert path.read_text(encoding="utf-8") == text, f"{path.name} is old; run: make docs"
    reference = ROOT / "docs" / "reference"
    assert {path for path in written if path.parent == reference} == {*reference.iterdir()}


@pytest.mark.parametrize("kind", key_reference.ROOTS)
def test_every_key_is_read_somewhere(kind: str) -> None:
    """One that nobody reads promises what does not happen. Numbers for a law of one's own are read by that law."""
    keys = [entry.name for table in key_reference.tables(kind) for entry in table.entries]
    assert [key for key in keys if not readers.readers(key)] in ([], ["controller.own"])
