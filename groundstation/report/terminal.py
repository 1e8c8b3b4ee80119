"""A run's result for a terminal of 80 columns: verdict with its cause, a line a robot or pair, requirements not met. Pure."""

from collections.abc import Iterator

from groundstation.analysis.cause import NOT_JUDGED, missed, title
from groundstation.analysis.numbers import deg, mm
from groundstation.analysis.results import Result
from groundstation.analysis.statistics import NOTHING

CELL = 7  # width of a number in characters: names of up to 10 leave the table within 80
GROUPS = (("RMS, whole run", 4), ("RMS after 20 s", 4), ("article", 2))


def lines(result: Result) -> Iterator[str]:
    """Yield the lines of a result from the top down. All lengths in mm, all angles in degrees."""
    if result.log_trouble:
        yield result.log_trouble
    if result.cause is not None:
        yield f"cause: {result.cause.sentence}"
        yield f"  {result.cause.injected_label}: {result.cause.injected or 'nothing'}"
        yield f"  outcome: {result.cause.outcome}"
    if not result.duration_s:
        yield "nothing was flown"
        return
    yield from _table(result)
    judged = () if result.verdict == NOT_JUDGED else result.checks
    for check in judged:
        if check.failed and check.reached and check.name != "faults":
            yield f"not met: {missed(check)}"
    skipped = [title(check) for check in judged if not check.reached]
    if skipped:
        yield f"not reached: {', '.join(skipped)}"
    for fault in result.faults:
        if result.cause is not None and (fault.time_s, fault.text) == (result.cause.time_s, result.cause.text):
            continue
        yield f"also at {fault.time_s:.1f} s, {fault.source}: {fault.text}"


def _table(result: Result) -> Iterator[str]:
    """Lines of the table of errors: over all time and from 20 s on, beside the article's where it has the robot."""
    rows = result.rows
    with_article = result.is_whole and any(row.article for row in rows.values())
    groups = GROUPS if with_article else GROUPS[:2]
    wide = max(len(name) for name in rows)
    yield f"{result.scene}, seed {result.seed}, {result.mode_text}, {result.duration_s:.0f} s: errors in mm, yaw in deg"
    yield (" " * wide + "".join(f" {heading:^{CELL * count - 1}}" for heading, count in groups)).rstrip()
    yield " " * wide + "".join(f"{axis:>{CELL}}" for _, count in groups for axis in ("x", "y", "z", "yaw")[:count])
    for name, row in rows.items():
        cells = [*_axes(row.rms_m), deg(row.rms_yaw_rad), *_axes(row.rms_after_20s_m), deg(row.rms_yaw_after_20s_rad)]
        if with_article:
            cells += [mm(value) for value in row.article.rms_m[:2]] if row.article else [NOTHING] * 2
        yield f"{name:{wide}}" + "".join(f"{cell:>{CELL}}" for cell in cells)


def _axes(values: tuple[float, ...] | None) -> list[str]:
    return [mm(value) for value in values or (None, None, None)]
