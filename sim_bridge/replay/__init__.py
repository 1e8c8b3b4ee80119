"""A recorded run through the robots' own code once more.

step_replay.py brings a log's inputs into the order in which a robot used them, rerun.py does its steps again, and step_diff.py
holds the outcome against what was done.
"""
