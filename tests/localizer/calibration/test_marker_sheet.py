"""Printed sheets of markers, drawn by another program and read by OpenCV: ids, direction, and millimetres."""

import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import numpy as np
import pypdfium2
import pytest
from typer.testing import CliRunner

from localizer.__main__ import cli
from localizer.calibration.marker_sheet import PAPERS_MM, RULER_MM
from localizer.detection.image_regions import Pixels
from shoal.frames import Array

SHEET_MM = PAPERS_MM["A4"]
PX_PER_MM = 12.0


def _drawn_pdf(path: Path) -> list[Pixels]:
    pages = pypdfium2.PdfDocument(str(path))
    drawn = [page.render(scale=PX_PER_MM * 25.4 / 72.0, grayscale=True).to_numpy() for page in pages]
    return [np.asarray(picture, dtype=np.uint8).reshape(picture.shape[:2]) for picture in drawn]


def _drawn_svg(path: Path) -> Pixels:
    """The path's rectangles, by a reading of SVG that knows no more than `M x y h v h z`."""
    root = ET.parse(path).getroot()
    assert root.attrib["width"] == f"{SHEET_MM[0]}mm" and root.attrib["viewBox"] == f"0 0 {SHEET_MM[0]} {SHEET_MM[1]}"
    picture = np.full([round(side * PX_PER_MM) for side in SHEET_MM[::-1]], 255, np.uint8)
    data = root.find("{http://www.w3.org/2000/svg}path")
    assert data is not None
    for box in data.attrib["d"].strip("Mz").split("zM"):
        x, y, w, h = (float(v) for v in box.replace("h", " ").replace("v", " ").split()[:4])
        left, top, right, bottom = (round(v * PX_PER_MM) for v in (x, y, x + w, y + h))
        picture[top:bottom, left:right] = 0
    return picture


def _read(picture: Pixels, family: str) -> dict[int, Array]:
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{family}"))
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, settings).detectMarkers(picture)
    pairs = zip([] if ids is None else np.ravel(ids), corners, strict=True)
    return {int(i): np.asarray(quad, dtype=np.float64).reshape(4, 2) for i, quad in pairs}


@pytest.mark.parametrize("family", ["4X4_50", "APRILTAG_36H11"])
def test_a_pdf_holds_all_markers_upright_and_at_true_scale(tmp_path: Path, family: str) -> None:
    out = tmp_path / "markers.pdf"
    done = CliRunner().invoke(
        cli, ["print-markers", "--ids", "1-6,10", "--size", "60", "--dictionary", family.lower(), "-o", str(out)]
    )
    assert done.exit_code == 0 and "2 sheets" in done.output
    pages = _drawn_pdf(out)
    assert pages[0].shape == pytest.approx([side * PX_PER_MM for side in SHEET_MM[::-1]], abs=1.5)
    quads = {number: quad for page in pages for number, quad in _read(page, family).items()}
    assert sorted(quads) == [1, 2, 3, 4, 5, 6, 10]
    for quad in quads.values():
        sides_mm = np.linalg.norm(quad - np.roll(quad, -1, axis=0), axis=1) / PX_PER_MM
        assert sides_mm == pytest.approx(60.0, abs=0.15)
        assert quad[0, 1] == pytest.approx(quad[1, 1], abs=2.0) and quad[0, 0] < quad[1, 0]  # its upper edge is above
    for page in pages:
        foot = page[-round(30 * PX_PER_MM) :] < 128
        dark_px = np.count_nonzero(foot, axis=1)
        assert dark_px.max() / PX_PER_MM == pytest.approx(RULER_MM, abs=0.3)
        ticks = foot[np.argmax(dark_px) - round(2 * PX_PER_MM)]
        at_mm = np.flatnonzero(np.diff(ticks.astype(int)) == 1) / PX_PER_MM
        assert at_mm - at_mm[0] == pytest.approx(np.arange(0.0, RULER_MM + 1.0, 10.0), abs=0.15)


def test_an_svg_holds_one_sheet(tmp_path: Path) -> None:
    out = tmp_path / "floor.svg"
    assert CliRunner().invoke(cli, ["print-markers", "--ids", "40", "--size", "140", "-o", str(out)]).exit_code == 0
    (number, quad), *others = _read(_drawn_svg(out), "4X4_50").items()
    assert (number, others) == (40, [])
    assert np.linalg.norm(quad[0] - quad[1]) / PX_PER_MM == pytest.approx(140.0, abs=0.2)


def test_markers_that_are_read_in_a_mirror_are_left_out(tmp_path: Path) -> None:
    """Of those that are printed none is read in a picture of all of them in a mirror."""
    out = tmp_path / "markers.pdf"
    done = CliRunner().invoke(cli, ["print-markers", "--ids", "0-49", "--size", "25", "-o", str(out)])
    assert done.exit_code == 0 and "Left out: 8, 9, 17, 47, which are read in a mirror too" in done.output
    pages = _drawn_pdf(out)
    assert {number for page in pages for number in _read(page, "4X4_50")} == set(range(50)) - {8, 9, 17, 47}
    for page in pages:
        assert not _read(np.ascontiguousarray(page[:, ::-1]), "4X4_50")


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--ids", "6-1"], "--ids 6-1: must be a list of ids and ranges"),
        (["--ids", "1-3,9-5"], "--ids 1-3,9-5: must be a list of ids and ranges"),
        (["--ids", "50"], "--ids 50: 4x4_50 has no such marker (allowed: 0 to 49)"),
        (["--ids", "1", "--size", "300"], "--size 300: does not fit on a sheet of A4 (allowed: above 0 to 142 mm)"),
        (["--ids", "1", "--dictionary", "5x5"], "--dictionary 5x5: not known (allowed: 4x4_50, apriltag_36h11)"),
        (["--ids", "1-10", "-o", "m.svg"], "they need 2 sheets"),
        (["--ids", "1", "--paper", "B5"], "--paper B5: not known (allowed: A4, A3)"),
        (["--ids", "8,9,17"], "--ids 8,9,17: the markers 8, 9, 17, 47 are read in a mirror too"),
        (["--ids", "1", "-o", "m.png"], "must end in .pdf or .svg"),
    ],
)
def test_markers_that_cannot_be_printed_are_refused_with_the_reason(options: list[str], why: str) -> None:
    assert why in str(CliRunner().invoke(cli, ["print-markers", *options]).exception)
