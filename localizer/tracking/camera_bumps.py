"""Judgement of which of several cameras was moved. Pure.

What tells it: the camera's own check marks; or poses that are elsewhere than another camera's and have left the motion of
their robot, while the other's have not. A leap of all that it measures makes it suspected until its marks tell. A suspected
camera is not trusted from the first picture on: it may be a misread marker. It is out when the suspicion lasts. It comes back
when it has agreed with another camera for a while, or when its check marks, if these had told, have been seen at their places
for as long and nothing contradicts. Until then it stays out, however long: it has to be surveyed anew.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

_SURE_S = 0.2  # s of suspicion without a break, then a camera is out: four pictures at 20 Hz; a misread marker lasts one
_MARKS_TELL_S = 0.3  # s in which check marks tell a knock, at 20 Hz; so long a leap is not told
_WELL_S = 2.0  # s of agreement after which it counts again; a bumped camera that swings agrees for a moment


@dataclass(frozen=True)
class Evidence:
    """Clues of a picture to cameras, by name."""

    moved: Mapping[str, str]  # its check marks say so, in these words
    in_place: frozenset[str]  # its check marks are seen at their places
    apart: Mapping[str, str]  # it is alone at fault, and by so much away from another
    leapt: frozenset[str]  # all the robots that it followed have left their motions in its picture, and its marks will tell
    agreed: frozenset[str]  # with another about a robot


@dataclass
class _Record:
    """Record of one camera."""

    suspected_s: float = 0.0  # for how long it has been suspected without a break
    suspected: bool = False
    well_s: float = 0.0  # for how long nothing has spoken against it, since it is out
    why: str = ""  # it is out; empty: it is not
    by_marks: bool = False  # its check marks have told so
    leapt_s: float = 0.0  # for how long all that it measures has been out of place


class CameraBumps:
    """Records of all cameras, by name."""

    def __init__(self, names: Collection[str]) -> None:
        self._records = {name: _Record() for name in names}

    @property
    def out(self) -> dict[str, str]:
        """Cameras that were moved, and how that shows, for people."""
        return {name: record.why for name, record in self._records.items() if record.why}

    @property
    def distrusted(self) -> set[str]:
        """Cameras that were moved, or may have been."""
        return {name for name, record in self._records.items() if record.why or record.suspected}

    def step(self, seen: Collection[str], told: Evidence, step_s: float) -> None:
        """Judge the cameras that are `seen`, some time after the last step. A suspicion of the others has its break."""
        for name, record in self._records.items():
            if name not in seen:
                record.suspected, record.suspected_s, record.leapt_s = False, 0.0, 0.0
                continue
            record.leapt_s = record.leapt_s + step_s if name in told.leapt else 0.0
            well = name in told.agreed or (record.by_marks and name in told.in_place)
            self._judge(record, told.moved.get(name, ""), told.apart.get(name, ""), well, step_s)

    def _judge(self, record: _Record, moved: str, apart: str, well: bool, step_s: float) -> None:
        record.suspected_s = record.suspected_s + step_s if record.suspected and apart else 0.0
        record.suspected = bool(apart) or 0.0 < record.leapt_s <= _MARKS_TELL_S
        if moved:
            record.why, record.by_marks, record.well_s = moved, True, 0.0
        elif apart and (record.why or record.suspected_s >= _SURE_S):
            record.why = f"it seems to have been moved: its poses are {apart} from those of another camera"
            record.by_marks, record.well_s = False, 0.0
        elif record.why:
            record.well_s += step_s if well else 0.0
            if record.well_s >= _WELL_S:
                record.why, record.by_marks, record.well_s = "", False, 0.0
