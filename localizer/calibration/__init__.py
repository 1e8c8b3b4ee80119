"""From pictures of boards and of surveyed points to a camera file: lens, then place over the pool.

Pictures (images.py) -> corners (targets.py) -> lens (intrinsics.py); surveyed points (survey_points.py) -> pose of the camera
through the water's surface (extrinsics.py). workflow.py leads, report.py and pool_grid.py show how good it is.
"""
