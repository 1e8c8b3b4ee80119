"""Pictures with their times, from a camera, files or the bus, and whether the camera is well.

factory.py opens the source that a command line names; it yields frames (base.py), the newest first where there are too many
(latest_value.py). Frozen, dark or wrongly sized pictures are kept out (health.py).
"""
