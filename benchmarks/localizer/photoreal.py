"""The localizer on pictures by another renderer (tests/localizer/photoreal): errors, consistency and track states by row.

Both splits in one figure. The simulator's renderer draws the same courses for the rows that it can draw.
"""

from collections.abc import Iterator

from benchmarks.harness import Row
from tests.localizer.photoreal.dataset import frames
from tests.localizer.photoreal.measure import SIMULATED, Frames, measure, rendered_rows, simulated
from tests.localizer.photoreal.rows import SPLITS

UNITS = {
    "rms_mm": "mm RMS", "max_mm": "mm, largest", "rms_deg": "deg RMS", "nees_xy": "NEES of x, y", "nees": "NEES of x, y, yaw",
    "marker_pct": "% MARKER", "kcf_pct": "% KCF", "coast_pct": "% COAST", "lost_pct": "% LOST",
    "false_matches": "false matches",
}  # fmt: skip


def run() -> Iterator[Row]:
    """One figure per row, renderer and unit; the samples are the splits."""
    for name in rendered_rows(SPLITS[0]):
        sources: dict[str, Frames] = {"Mitsuba": frames} | ({"simulator": simulated} if name in SIMULATED else {})
        for subject, source in sources.items():
            splits = [measure(name, split, source) for split in SPLITS]
            for field, unit in UNITS.items():
                yield Row.of("photoreal", name, subject, unit, [float(getattr(figures, field)) for figures in splits])
