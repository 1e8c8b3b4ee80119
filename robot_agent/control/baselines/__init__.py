"""Control laws of the literature, tuned on the same budget, for comparison with the MPC.

Start with feedback.py; docs/baselines.md has equations and figures. All laws take the same tracking errors
(tracking_errors.py) and return a wrench; limits and allocation after them are the same.
"""
