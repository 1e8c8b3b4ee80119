"""Settings of camera, landmarks and localizer."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from wire.config.scene import Vec2, Vec3
from wire.config.vehicle import Fraction, NotNegative, Positive
from wire.toml_loader import Section

LANDMARKS_NEEDED = 4  # one could place a camera, but tilt and sway look alike across 0.2 m; four also show which one was moved


class Camera(Section):
    """The overhead camera: OpenCV's pinhole model with distortion, in air above flat water. The image's x runs along
    `rotation_rad` = 0 with the pool's x, its y with the pool's y. Pixel (0, 0) is the CENTRE of the first pixel."""

    size_px: tuple[Annotated[int, Field(ge=64, le=8192)], Annotated[int, Field(ge=64, le=8192)]]
    rate_hz: Annotated[float, Field(ge=1, le=240)]
    exposure_s: Annotated[float, Field(gt=0, le=0.05)]
    stamp_marks: Literal["start", "end"] = "end"  # of the exposure: what the camera driver's time stamps tell
    readout_s: Annotated[float, Field(ge=0, le=0.1)] = (
        0.0  # rolling shutter: last row after the first; poses are of the middle one
    )
    focal_px: tuple[Positive, Positive]
    centre_px: Vec2
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    position_m: Vec3
    rotation_rad: Vec3 = (0.0, 0.0, 0.0)
    water_index: Annotated[float, Field(ge=1, le=2)] = 1.333

    @model_validator(mode="after")
    def _above_water(self) -> Self:
        if self.position_m[2] >= 0:
            raise ValueError(f"position_m z = {self.position_m[2]}: the camera must hang above the water (z < 0)")
        return self

    @property
    def px_per_m(self) -> float:
        """The scale of the picture at the water's surface, straight below the camera."""
        return max(self.focal_px) / -self.position_m[2]


class CameraFile(Section):
    """A file that `localizer calibrate` wrote: an experiment names it as `camera = "lab.toml"`."""

    camera: Camera


class Landmark(Section):
    """A marker (ArUco, DICT_4X4_50) that lies flat and still where its place is known: on the rim (z <= 0) or on the floor.
    Its upper edge points along `yaw_rad`, as a robot's does."""

    id: Annotated[int, Field(ge=0, le=49)]
    position_m: Vec3
    yaw_rad: float = 0.0
    side_m: Positive = 0.2


class Localizer(Section):
    """The tracking of the robots in the camera's pictures."""

    # poses come from [camera]'s pictures. False: from elsewhere, as a simulation's truth; then no path has to stay in the
    # picture, and obstacles are not watched for
    uses_camera: bool = True
    markers: bool = True
    template_px: Annotated[int, Field(ge=16, le=128)] = 48
    min_peak: Fraction = 0.3
    lost_after_s: Positive = 0.7
    frozen_frames: Annotated[int, Field(ge=2)] = 5
    depth_sigma_m: Positive = 0.015  # of reported depths: mostly their zero. 1 hPa of air pressure and 5 deg of trim are 1 cm
    # One standard deviation of an unknown roll and of pitch, which move the plate over the centre: at rest, and per newton of
    # the thrust that the robot's motion takes. The latter is the thrusters' distance below the centre over the righting moment
    # per sine, here 0.05 m / 1.9 N m.
    tilt_sigma_rad: Annotated[float, Field(ge=0, le=0.5)] = 0.002
    tilt_rad_per_n: Annotated[float, Field(ge=0, le=1)] = 0.026
    surface_slope_rad: Annotated[float, Field(ge=0, le=0.2)] = 0.0043  # one standard deviation of the water's slope
    attitude_sigma_rad: Annotated[float, Field(ge=0, le=0.5)] = 0.005  # of roll and pitch as a board tells them: its level
    preview_rate_hz: NotNegative = 5.0
    obstacle_min_m: NotNegative = 0.08  # what covers less than a square of this side is no obstacle; 0: none are looked for
