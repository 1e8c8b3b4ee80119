"""The station's conduct of a mission: obstacles, robots that lag, robots that are lost."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from shoal.config.loader import Section
from shoal.config.vehicle import NotNegative, Positive


class MissionConfig(Section):
    """Keys of the mission: what the station does with robots that are lost, late or back (docs/missions.md)."""

    lost: Literal["abort", "hold", "go-on", "close-up"] = "abort"
    """The others' reaction to a lost robot: disarm; hold; go on; or take the nodes of the file's first robots."""
    detours: bool = True
    """Lead the formation around obstacles on its path, if all robots share it."""
    blind: Literal["warn", "hold"] = "hold"
    """While obstacles cannot be detected: no robot starts, and those that fly hold; or only an alarm."""
    detour_clear_m: NotNegative = 0.25
    """Distance of a detour from obstacles, beyond safety.radius_m. Robots give way by themselves at 0.15."""
    wait_from_m: Annotated[Positive | None, Field(examples=[0.2])] = None
    """Worst tracking error at which the formation begins to slow down; left out: it never does."""
    wait_at_m: Positive = 0.5
    """Worst tracking error at which the formation is at its slowest."""
    slowest: Annotated[float, Field(gt=0, le=1)] = 0.05
    """Least pace of a formation that slows down, as a share of the timetable's."""
    return_mps: Positive = 0.15
    """Speed on the way back to the start, and into place."""
    start_within_m: Positive = 0.5
    """Largest distance from its planned start at which a robot may be armed."""
    clock_offset_ms: Positive = 20.0
    """Largest offset of a robot's clock from the station's."""
    thruster_test: bool = False
    """Let a robot arm only after it has passed a thruster test."""

    @model_validator(mode="after")
    def _slows_before_it_stands(self) -> Self:
        if self.wait_from_m is not None and not self.wait_from_m < self.wait_at_m:
            raise ValueError(f"wait_at_m = {self.wait_at_m} must be more than wait_from_m = {self.wait_from_m}")
        return self
