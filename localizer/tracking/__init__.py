"""Tracking: from what frames show to robots' poses over time.

fleet_localizer.py leads a frame through: predicted view (kalman.py, observation.py), marker or appearance match
(appearance.py), the rules for what may change a track (robot_track.py), what speaks against a marker or a board
(plausibility.py), tilt (tilt.py), pose with covariance.
camera_pose.py finds a moving camera from landmarks, check_marks.py notices that a fixed one was bumped or that the water sank;
camera_fusion.py fuses what several cameras tell.
"""
