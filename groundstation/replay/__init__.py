"""A recorded run used again: on the bus, through the robots' own program, as a state to go on from.

step_replay.py hands the log's inputs to `robot-agent rerun`, step_diff.py holds the outcome against what was done.
"""
