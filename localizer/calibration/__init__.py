"""Camera calibration: from pictures of targets and of surveyed points to a camera file.

Pictures (images.py) -> corners (targets.py) -> intrinsics (intrinsics.py); surveyed points (survey_points.py) -> pose of
the camera through the water's surface (extrinsics.py). workflow.py runs `localizer calibrate`, verify.py `localizer
check`; report.py and pool_grid.py show the accuracy.
"""
