"""Settings of camera, landmarks and localizer."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from shoal.config.loader import Section
from shoal.config.scene import Vec2, Vec3
from shoal.config.vehicle import Fraction, NotNegative, Positive

MarkerFamily = Literal["4x4_50", "apriltag_36h11"]
"""A dictionary of markers, by OpenCV's name without DICT_."""

LANDMARKS_NEEDED = 4  # one could place a camera, but tilt and sway look alike across 0.2 m; four also show which one was moved


class Camera(Section):
    """The overhead camera: OpenCV's pinhole model with distortion, in air above flat water. The image's x runs along
    `rotation_rad` = 0 with the pool's x, its y with the pool's y. Pixel (0, 0) is the CENTRE of the first pixel."""

    size_px: tuple[Annotated[int, Field(ge=64, le=8192)], Annotated[int, Field(ge=64, le=8192)]]
    """Width and height of a picture."""
    rate_hz: Annotated[float, Field(ge=1, le=240)]
    """Pictures per second."""
    exposure_s: Annotated[float, Field(gt=0, le=0.05)]
    """Exposure time."""
    stamp_marks: Literal["start", "end"] = "end"
    """The end of the exposure that the driver's stamps mark."""
    readout_s: Annotated[float, Field(ge=0, le=0.1)] = 0.0
    """Time of a rolling shutter from the first row to the last. Stamps are of the middle row."""
    focal_px: tuple[Positive, Positive]
    """Focal lengths along the picture's x and y."""
    centre_px: Vec2
    """Principal point, x and y."""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """OpenCV's k1, k2, p1, p2, k3."""
    position_m: Vec3
    """Position in the pool frame. z is negative: the camera hangs above the water."""
    rotation_rad: Vec3 = (0.0, 0.0, 0.0)
    """Rotation vector (Rodrigues) from pool frame to camera frame."""
    water_index: Annotated[float, Field(ge=1, le=2)] = 1.333
    """Refractive index of the water."""
    masks_px: tuple[Annotated[tuple[Vec2, ...], Field(min_length=3)], ...] = ()
    """Polygons of the picture in which nothing is looked for: a ladder, the deck."""
    controls: Annotated[tuple[tuple[str, int], ...], Field(examples=[[["gain", 20]]])] = ()
    """Values of the camera's own controls (V4L2)."""

    @model_validator(mode="after")
    def _above_water(self) -> Self:
        if self.position_m[2] >= 0:
            raise ValueError(f"position_m z = {self.position_m[2]}: the camera must hang above the water (z < 0)")
        return self

    @property
    def px_per_m(self) -> float:
        """The scale of the picture at the water's surface, straight below the camera."""
        return max(self.focal_px) / -self.position_m[2]


class NamedCamera(Camera):
    """One of several cameras over one pool. Poses are in one pool frame: each is calibrated by points of the same survey."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]*$", max_length=24, examples=["west"])]
    """Name, in topics, reports and faults."""


UNSEEING = Camera(
    size_px=(1280, 960), rate_hz=20.0, exposure_s=0.008, focal_px=(1005.0, 1005.0), centre_px=(639.5, 479.5),
    position_m=(0.0, 0.0, -2.8),
)  # fmt: skip
"""Stands for the camera of an experiment without one. Only its rate counts: poses come as often."""


class CameraFile(Section):
    """A file that `localizer calibrate` wrote: an experiment names it as `camera = "lab.toml"`."""

    camera: Camera
    """The calibrated camera."""


class Landmark(Section):
    """A marker that lies flat and still where its place is known: on the rim (z <= 0) or on the floor.
    Its upper edge points along `yaw_rad`, as a robot's does."""

    id: Annotated[int, Field(ge=0, le=49, examples=[40])]
    """Marker id, used by no robot."""
    position_m: Annotated[Vec3, Field(examples=[[1.2, -0.8, 1.0]])]
    """Centre of the marker in the pool frame."""
    yaw_rad: float = 0.0
    """Direction of the marker's upper edge."""
    side_m: Positive = 0.2
    """Side of the marker's black square."""


class Localizer(Section):
    """The tracking of the robots in the camera's pictures."""

    uses_camera: bool = True
    """Poses come from [camera]'s pictures. False: from elsewhere; then paths may leave the picture, and nobody watches for
    obstacles."""
    markers: bool = True
    """Read markers. False: follow robots by their looks alone."""
    marker_family: MarkerFamily = "4x4_50"
    """Dictionary of all markers. Ids are 0 to 49 in both."""
    basin_margin_m: NotNegative = 0.2
    """Distance outside the pool's outline beyond which a pose is ignored."""
    template_px: Annotated[int, Field(ge=16, le=128)] = 48
    """Side of the correlation filter's template."""
    corner_sigma_px: Positive = 0.2
    """Standard deviation of a coordinate of a marker's corner. With H.264 at a rate factor of 30: 0.5."""
    min_peak: Fraction = 0.3
    """Least peak of the correlation that is taken for the robot."""
    lost_after_s: Positive = 0.7
    """Time without a measurement after which a robot is lost."""
    frozen_frames: Annotated[int, Field(ge=2)] = 5
    """Number of equal pictures in a row after which the camera is taken for frozen."""
    depth_sigma_m: Positive = 0.015
    """Standard deviation of reported depths. 1 hPa of air pressure and 5 deg of trim are 1 cm."""
    tilt_sigma_rad: Annotated[float, Field(ge=0, le=0.5)] = 0.05
    """Standard deviation at rest of roll and pitch that a board does not measure."""
    tilt_rad_per_n: Annotated[float, Field(ge=0, le=1)] = 0.026
    """Tilt per newton of thrust: the thrusters' distance below the centre over the righting moment."""
    tilt_from_outline: bool = False
    """Read roll and pitch that boards do not measure off the picture. The hull must be a sphere of `vehicle.radius_m`."""
    surface_slope_rad: Annotated[float, Field(ge=0, le=0.2)] = 0.0043
    """Standard deviation of the slope of the water's surface."""
    attitude_sigma_rad: Annotated[float, Field(ge=0, le=0.5)] = 0.005
    """Standard deviation of roll and pitch that a board measures."""
    preview_rate_hz: NotNegative = 5.0
    """Rate of the annotated pictures for people; 0: none."""
    obstacle_min_m: NotNegative = 0.08
    """Side of the smallest square that is taken for an obstacle; 0: no watch."""
