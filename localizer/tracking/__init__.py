"""From what pictures show to where the robots are, over time.

fleet_localizer.py leads a frame through: expected place (kalman.py), observation (observation.py), rules for what may change
the belief (robot_track.py), pose with covariance (tilt.py). camera_pose.py finds a moving camera from landmarks.
"""
