"""The robot's reference: sampled along the trajectory, pulled by the formation, led around robots and obstacles.

The trajectory's clock (trajectory_clock.py) gives the reference (reference.py). Neighbours pull it (formation.py); robots and
obstacles in the way bend it (velocity_obstacles.py, obstacles.py). trajectory_check.py refuses what cannot be flown.
"""
