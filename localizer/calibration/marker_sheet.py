"""Sheets of markers to print at true scale, as PDF or SVG, with a ruler that shows whether the printer kept it. Pure.

Lengths are in mm from the sheet's upper left corner. A marker's black cells are one path, so that no seams show between them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape

import cv2
import numpy as np

from localizer.detection.fiducials import marker_dictionary
from shoal.config.perception import MarkerFamily
from shoal.errors import ConfigError

Rectangle = tuple[float, float, float, float]  # left, top, width, height

PAPERS_MM = {"A4": (210.0, 297.0), "A3": (297.0, 420.0)}  # ISO 216
RULER_MM = 100.0
_MARGIN_MM = 10.0  # that printers leave white
_FOOT_MM = 13.0  # for the ruler and its words
_LABEL_MM, _TEXT_MM = 4.0, 3.0  # room above and below a marker, and size of letters
_PT_PER_MM = 72.0 / 25.4


@dataclass(frozen=True)
class MarkerSheet:
    """One sheet and its size: black rectangles, and texts with the place where their line begins."""

    size_mm: tuple[float, float]
    black: tuple[Rectangle, ...]
    texts: tuple[tuple[float, float, str], ...]


def marker_sheets(ids: Sequence[int], size_mm: float, family: MarkerFamily, paper: str = "A4") -> list[MarkerSheet]:
    """Sheets of a paper with markers whose black square is `size_mm` wide, with a white cell around. Raises ConfigError."""
    dictionary = marker_dictionary(family)
    marker_count, cells = len(dictionary.bytesList), dictionary.markerSize + 2
    for number in ids:
        if not 0 <= number < marker_count:
            raise ConfigError(f"--ids {number}: {family} has no such marker (allowed: 0 to {marker_count - 1})")
    if paper not in PAPERS_MM:
        raise ConfigError(f"--paper {paper}: not known (allowed: {', '.join(PAPERS_MM)})")
    sheet_mm = PAPERS_MM[paper]
    room_mm = sheet_mm[0] - 2 * _MARGIN_MM, sheet_mm[1] - 2 * _MARGIN_MM - _FOOT_MM
    largest_mm = min(room_mm[0], room_mm[1] - 2 * _LABEL_MM) / (1 + 2 / cells)
    if not 0.0 < size_mm <= largest_mm:
        raise ConfigError(f"--size {size_mm:g}: does not fit on a sheet of {paper} (allowed: above 0 to {int(largest_mm)} mm)")
    cell_mm = size_mm / cells
    across_mm, down_mm = size_mm + 2 * cell_mm, size_mm + 2 * cell_mm + 2 * _LABEL_MM
    columns, rows = int(room_mm[0] / across_mm + 1e-9), int(room_mm[1] / down_mm + 1e-9)
    sheets = []
    for first in range(0, len(ids), columns * rows):
        black, texts = list[Rectangle](), list[tuple[float, float, str]]()
        for k, number in enumerate(ids[first : first + columns * rows]):
            left = _MARGIN_MM + (k % columns) * across_mm + cell_mm
            top = _MARGIN_MM + (k // columns) * down_mm + cell_mm + _LABEL_MM
            black += _cells(np.asarray(cv2.aruco.generateImageMarker(dictionary, number, cells)), left, top, cell_mm)
            texts.append((left, top - cell_mm - 1.0, "^ ahead"))
            texts.append((left, top + size_mm + cell_mm + _TEXT_MM, f"{number}   {family}   {size_mm:g} mm"))
        sheets.append(MarkerSheet(sheet_mm, (*black, *_ruler(sheet_mm[1])), (*texts, _ruler_text(sheet_mm[1]))))
    return sheets


def mirrored_ids(family: MarkerFamily) -> tuple[int, ...]:
    """Ids of the markers that are read in a mirror too, as themselves or as another marker: a reflection at a wall, or at the
    surface from below, looks like a robot."""
    dictionary = marker_dictionary(family)
    count, side = len(dictionary.bytesList), dictionary.markerSize
    bits = [
        cv2.aruco.Dictionary.getBitsFromByteList(dictionary.bytesList[number : number + 1], side) for number in range(count)
    ]
    mirrored = (np.ascontiguousarray(pattern[:, ::-1]) for pattern in bits)
    return tuple(number for number, pattern in enumerate(mirrored) if dictionary.identify(pattern, 0.0)[0])


def as_svg(sheet: MarkerSheet) -> str:
    """One sheet as SVG."""
    width, height = sheet.size_mm
    path = "".join(f"M{x:.4f} {y:.4f}h{w:.4f}v{h:.4f}h{-w:.4f}z" for x, y, w, h in sheet.black)
    texts = "".join(f'<text x="{x:.3f}" y="{y:.3f}">{escape(text)}</text>\n' for x, y, text in sheet.texts)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" viewBox="0 0 {width} {height}" '
        f'font-family="Helvetica, Arial, sans-serif" font-size="{_TEXT_MM}">\n'
        f'<rect width="{width}" height="{height}" fill="white"/>\n<path d="{path}"/>\n{texts}</svg>\n'
    )


def as_pdf(sheets: Sequence[MarkerSheet]) -> bytes:
    """All sheets as PDF 1.4 (ISO 32000-1), for printing at 100 %."""
    pages = [4 + 2 * i for i in range(len(sheets))]  # object numbers; each page's content is the one after it
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        f"<< /Type /Pages /Count {len(pages)} /Kids [{' '.join(f'{n} 0 R' for n in pages)}] >>".encode(),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    for number, sheet in zip(pages, sheets, strict=True):
        box = " ".join(f"{side * _PT_PER_MM:.4f}" for side in sheet.size_mm)
        content = _pdf_content(sheet).encode("ascii")
        objects.append(
            f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {box}] /Resources << /Font << /F 3 0 R >> >> "
            f"/Contents {number + 1} 0 R >>".encode()
        )
        objects.append(b"<< /Length %d >>\nstream\n%s\nendstream" % (len(content), content))
    data, starts = b"%PDF-1.4\n", list[int]()
    for number, body in enumerate(objects, start=1):
        starts.append(len(data))
        data += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = b"".join(b"%010d 00000 n \n" % start for start in starts)
    head = b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    return (
        data + head + table + b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, len(data))
    )


def _cells(bits: np.ndarray, left: float, top: float, cell_mm: float) -> Iterator[Rectangle]:
    """The black cells (n, n), neighbours in a row as one rectangle."""
    for row, line in enumerate(bits < 128):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], line, [False]]).astype(int)))
        for start, end in edges.reshape(-1, 2).tolist():
            yield left + start * cell_mm, top + row * cell_mm, (end - start) * cell_mm, cell_mm


def _ruler(height_mm: float) -> list[Rectangle]:
    """A line of RULER_MM with a tick each cm."""
    top = height_mm - _MARGIN_MM - _TEXT_MM - 6.0
    ticks = [(_MARGIN_MM + 10.0 * i - 0.1, top - 4.0, 0.2, 4.0) for i in range(int(RULER_MM / 10.0) + 1)]
    return [(_MARGIN_MM, top, RULER_MM, 0.3), *ticks]


def _ruler_text(height_mm: float) -> tuple[float, float, str]:
    text = f"From the first tick to the last it is {RULER_MM:g} mm. If not: print at 100 %, not fitted to the page."
    return _MARGIN_MM, height_mm - _MARGIN_MM - 2.0, text


def _pdf_content(sheet: MarkerSheet) -> str:
    """Drawing operators, in mm with y upwards."""
    height = sheet.size_mm[1]
    boxes = "".join(f"{x:.4f} {height - y - h:.4f} {w:.4f} {h:.4f} re\n" for x, y, w, h in sheet.black)
    texts = "".join(
        f"BT /F {_TEXT_MM} Tf {x:.3f} {height - y:.3f} Td ({_escaped(text)}) Tj ET\n" for x, y, text in sheet.texts
    )
    return f"{_PT_PER_MM:.8f} 0 0 {_PT_PER_MM:.8f} 0 0 cm\n{boxes}f\n{texts}"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
