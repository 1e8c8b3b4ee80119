"""The station's conduct of a mission: obstacles, robots that lag, robots that are lost."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from wire.config.vehicle import NotNegative, Positive
from wire.toml_loader import Section


class MissionConfig(Section):
    """The experiment's `[mission]`."""

    # when a robot falls out: everybody disarms; holds; goes on without it; or the others take the places of the file's first
    # robots, so that the gap closes
    lost: Literal["abort", "hold", "go-on", "close-up"] = "abort"
    detours: bool = True  # lead the formation round what the localizer sees lying on its path (paths of waypoints and routes)
    # while obstacles cannot be detected (a lamp was switched, the camera was moved, the localizer is silent): with "hold" no
    # robot starts, and robots that fly hold until they can be detected again; "warn" raises an alarm and flies on
    blind: Literal["warn", "hold"] = "hold"
    detour_clear_m: NotNegative = 0.25  # beyond safety.radius_m: robots begin to give way by themselves at 0.15
    wait_from_m: Positive | None = None  # worst tracking error from which the formation slows down; None: never
    wait_at_m: Positive = 0.5  # and at which it all but stands
    slowest: Annotated[float, Field(gt=0, le=1)] = 0.05  # of the timetable's pace
    return_mps: Positive = 0.15  # on the way back to the start, and into place
    start_within_m: Positive = 0.5  # of where it should start, for a robot to be armed
    clock_offset_ms: Positive = 20.0  # the most that a robot's clock may be off the station's: else logs do not line up
    thruster_test: bool = False  # a robot arms only after it has passed one

    @model_validator(mode="after")
    def _slows_before_it_stands(self) -> Self:
        if self.wait_from_m is not None and not self.wait_from_m < self.wait_at_m:
            raise ValueError(f"wait_at_m = {self.wait_at_m} must be more than wait_from_m = {self.wait_from_m}")
        return self
