"""The numbers of one good flight."""

from groundstation.analysis.comparison import FlightMetrics

GOOD = FlightMetrics(
    rms_m=0.1, rms_after_20s_m=0.01, max_after_20s_m=0.02, rms_yaw_rad=0.0, rms_yaw_after_20s_rad=0.0, formation_rms_m=0.1,
    formation_after_20s_m=0.01, min_separation_m=None, input_step_rms=0.1, wanted_too_large=0.0, wanted_too_fast=0.0,
    wanted_beyond=0.0, wanted_most=1.0, under_way=1.0,
)  # fmt: skip
