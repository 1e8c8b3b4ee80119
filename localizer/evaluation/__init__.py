"""How good the localizer is: errors against known truth, and the age of its poses.

A recording and its truth (ground_truth.py) are run through the localizer (runner.py) into tables of errors (metrics.py);
latency.py measures camera and computer.
"""
