"""Control laws of the literature, tuned on the same budget, to compare the ESO-MPC with.

Start with feedback.py; docs/baselines.md has equations and figures. Each takes the same tracking errors (tracking_errors.py)
and gives a wrench, with the same limits and allocation behind it.
"""
