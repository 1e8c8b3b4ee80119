"""The built page belongs to its sources, and is small. No Node is needed to know."""

import gzip
import hashlib
import json
from pathlib import Path

import pytest

from groundstation.web.server import STATIC
from localizer.setup.server import STATIC as SETUP

pytestmark = pytest.mark.real_time

SOURCES = Path(__file__).parents[2] / "groundstation" / "web" / "page"
BESIDE = ("index.html", "package-lock.json", "package.json", "setup.html", "tsconfig.json", "vite.config.ts")
LARGEST_BYTES = 150_000


def test_the_build_is_made_from_these_sources() -> None:
    inside = [str(path.relative_to(SOURCES).as_posix()) for path in (SOURCES / "src").rglob("*") if path.is_file()]
    digest = hashlib.sha256()
    for name in [*sorted([*BESIDE, *inside]), "../../report/templates/paper.js"]:
        digest.update(f"{name}\0".encode() + (SOURCES / name).read_bytes() + b"\0")
    for page in (STATIC, SETUP):
        assert json.loads((page / "build.json").read_text())["sources"] == digest.hexdigest(), "run: make page"


def test_the_page_is_small() -> None:
    """Without what is loaded on demand: the 3-D view, and what draws figures for a paper."""
    sizes = {path.name: len(gzip.compress(path.read_bytes())) for path in STATIC.rglob("*") if path.is_file()}
    at_once = sum(size for name, size in sizes.items() if not name.startswith(("three", "paper")))
    assert 10_000 < at_once <= LARGEST_BYTES, sizes


def test_the_lock_names_no_host() -> None:
    lock = (SOURCES / "package-lock.json").read_text()
    assert '"resolved"' not in lock
    assert "integrity" in lock


def test_reports_carry_the_same_plots_as_the_page() -> None:
    wanted = json.loads((SOURCES / "package.json").read_text())["devDependencies"]["uplot"]
    carried = (STATIC.parents[1] / "report" / "templates" / "uplot.min.js").read_text(encoding="utf-8")
    assert f"(v{wanted})" in carried[:200], "run: make page"
