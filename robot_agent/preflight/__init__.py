"""Checks before a robot goes into the water: `robot-agent check` and its parts.

Each part gives findings (findings.py): computer, network (network.py), board (board.py), thrusters (thrusters.py), and
the time of a control step (rehearsal.py).
"""
