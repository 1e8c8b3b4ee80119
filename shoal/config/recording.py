"""The log's video of the camera, and the disk space that recording leaves free."""

from typing import Annotated, Literal

from pydantic import Field

from shoal.config.loader import Section
from shoal.config.vehicle import NotNegative, Positive


class Recording(Section):
    """Video in the log, besides the preview (`localizer.preview_rate_hz`). It is made where the localizer runs."""

    video: Literal["none", "h264", "jpeg"] = "none"
    """Codec of the camera's video in the log."""
    video_rate_hz: Positive = 20.0
    """Pictures per second of the video."""
    video_scale: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Width and height of the video, as a share of the camera's."""
    video_mbps: Positive = 4.0
    """Bit rate of H.264."""
    jpeg_quality: Annotated[int, Field(ge=10, le=100)] = 80
    """Quality of JPEG pictures."""
    min_free_gb: NotNegative = 0.5
    """Free disk space without which no run begins."""
    stop_video_below_gb: NotNegative = 0.3
    """Free disk space below which pictures are no longer recorded."""
