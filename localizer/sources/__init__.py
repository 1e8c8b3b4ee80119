"""Sources of frames: camera, files or bus, with times, and the camera's health.

factory.py opens the source that a command line names. It yields captured frames (base.py), the newest first when there are
too many (latest_value.py). Frozen, dark or wrongly sized frames are kept out (health.py).
"""
