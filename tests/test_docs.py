"""Generated pages are current, and no page points at a file that is not there."""

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


def test_the_page_of_messages_is_current() -> None:
    page = runpy.run_path(str(ROOT / "docs" / "messages.py"))["page"]
    assert (ROOT / "docs" / "messages.md").read_text(encoding="utf-8") == page(), "run: make docs"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_files_named_in_text_exist(page: Path) -> None:
    """`package/file.py` in backquotes is a promise; files get renamed."""
    packages = "wire|localizer|robot_agent|groundstation|sim_bridge|tests|benchmarks|docs"
    for name in re.findall(rf"`((?:{packages})/[\w./-]*\.\w+)`", page.read_text(encoding="utf-8")):
        assert (ROOT / name).exists(), f"{page.name} names {name}"


def test_the_reference_of_keys_and_the_schemas_are_current() -> None:
    files = runpy.run_path(str(ROOT / "docs" / "keys.py"))["files"]()
    for path, text in files.items():
        assert path.read_text(encoding="utf-8") == text, "run: make docs"
    assert {path for path in files if path.suffix == ".md"} == {*(ROOT / "docs" / "reference").iterdir()}
