"""Judgement of which of several cameras was moved. Pure.

What tells it: the camera's own check marks; or poses that are elsewhere than another camera's and have left the motion of
their robot, while the other's have not. A leap of all that it measures makes it suspected until its marks tell. A suspected
camera is not trusted from the first picture on, in which nobody knows yet
whether a marker was misread; it is out when the suspicion lasts. It comes back when it has agreed with another camera for a
while, or when its check marks, if these had told, have been at their places again for as long and nothing contradicts. Until
then it stays out, however long: it has to be surveyed anew.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

_SURE_S = 0.2  # s of suspicion without a break, then a camera is out: four pictures at 20 Hz; a misread marker lasts one
_MARKS_TELL_S = (
    0.3  # s in which check marks tell a knock, at 20 Hz; so long a leap of all that one camera measures is not told
)
_WELL_S = 2.0  # s of agreement after which it counts again; a bumped camera that swings agrees for a moment


@dataclass(frozen=True)
class Evidence:
    """Clues of a picture to cameras, by name: in which words the check marks of one say that it was `moved`; by how much one
    is `apart_m` from another and alone at fault; which have `leapt`, out of the motions of all the robots that they followed;
    and which have `agreed` with another about a robot."""

    moved: Mapping[str, str]
    apart_m: Mapping[str, float]
    leapt: frozenset[str]
    agreed: frozenset[str]


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
        """Judge the cameras that are `seen`, some time after the last step."""
        for name in seen:
            record, apart_m = self._records[name], told.apart_m.get(name, 0.0)
            record.leapt_s = record.leapt_s + step_s if name in told.leapt else 0.0
            self._judge(record, told.moved.get(name, ""), apart_m, name in told.agreed, step_s)

    def _judge(self, record: _Record, moved: str, apart_m: float, agreed: bool, step_s: float) -> None:
        record.suspected_s = record.suspected_s + step_s if record.suspected and apart_m else 0.0
        record.suspected = bool(apart_m) or 0.0 < record.leapt_s <= _MARKS_TELL_S
        if moved:
            record.why, record.by_marks, record.well_s = moved, True, 0.0
        elif apart_m and (record.why or record.suspected_s >= _SURE_S):
            record.why = f"it seems to have been moved: its poses are {apart_m * 1e3:.0f} mm from those of another camera"
            record.by_marks, record.well_s = False, 0.0
        elif record.why:
            record.well_s += step_s if agreed or record.by_marks else 0.0
            if record.well_s >= _WELL_S:
                record.why, record.by_marks, record.well_s = "", False, 0.0
