"""Judgement of which of several cameras was moved. Pure.

What tells it: the camera's own check marks; or poses that are elsewhere than another camera's and have left the motion of
their robot, while the other's have not. A leap of all that it measures makes it suspected until its marks tell. A suspected
camera is not trusted from the first picture on: it may be a misread marker. It is out when the suspicion lasts. A camera
whose check marks are seen at their places, for longer than they take to tell a knock, was not moved, whatever its poses are:
it is no longer alone at fault. A camera that is out comes back when it has agreed with another camera for a while, or when
its check marks have been seen at their places for as long and nothing contradicts. Until then it stays out, however long: it
has to be surveyed anew.
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
    suspected_s: float = 0.0  # for how long it has been suspected without a break
    suspected: bool = False
    well_s: float = 0.0  # for how long nothing has spoken against it, since it is out
    why: str = ""  # it is out; empty: it is not
    apart_in_place_s: float = 0.0  # for how long it has been apart while its check marks were at their places
    proven: bool = False  # its check marks have told that it was not moved, although it is apart
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

    @property
    def proven(self) -> set[str]:
        """Cameras that were not moved, by their check marks, although their poses are apart from another camera's."""
        return {name for name, record in self._records.items() if record.proven}

    def step(self, cameras: Collection[str], evidence: Evidence, step_s: float) -> None:
        """Judge `cameras`, some time after the last step. A suspicion of the others has its break."""
        for name, record in self._records.items():
            if name not in cameras:
                record.suspected, record.suspected_s, record.leapt_s = False, 0.0, 0.0
                continue
            record.leapt_s = record.leapt_s + step_s if name in evidence.leapt else 0.0
            self._prove(record, name in evidence.in_place, name in evidence.agreed, name in evidence.apart, step_s)
            well = name in evidence.agreed or name in evidence.in_place
            apart = "" if record.proven else evidence.apart.get(name, "")
            self._judge(record, evidence.moved.get(name, ""), apart, well, name in evidence.in_place, step_s)

    def _prove(self, record: _Record, in_place: bool, agreed: bool, apart: bool, step_s: float) -> None:
        """Note whether its check marks have been at their places for longer than they take to tell a knock."""
        if not in_place or agreed:
            record.proven, record.apart_in_place_s = False, 0.0
        elif apart:
            record.apart_in_place_s += step_s
            record.proven = record.proven or record.apart_in_place_s > _MARKS_TELL_S

    def _judge(self, record: _Record, moved: str, apart: str, well: bool, in_place: bool, step_s: float) -> None:
        """Take a camera out, or in again. Out: its check marks show that it was `moved` (the reason), or its poses are `apart`
        from another camera's for _SURE_S and its marks are not `in_place`. In: it has been `well` for _WELL_S."""
        record.suspected_s = record.suspected_s + step_s if record.suspected and apart else 0.0
        record.suspected = bool(apart) or 0.0 < record.leapt_s <= _MARKS_TELL_S
        if moved:
            record.why, record.well_s = moved, 0.0
        elif apart and (record.why or (record.suspected_s >= _SURE_S and not in_place)):
            record.why = f"it seems to have been moved: its poses are {apart} from those of another camera"
            record.well_s = 0.0
        elif record.why:
            record.well_s += step_s if well else 0.0
            if record.well_s >= _WELL_S:
                record.why, record.well_s = "", 0.0
