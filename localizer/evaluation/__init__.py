"""Accuracy of the localizer against ground truth, and age of its poses.

runner.py reads a recording and its truth and runs the localizer on it; metrics.py makes tables of errors; offline.py writes
the poses of a recording to a table, and compares them with those that were published; latency.py measures camera and computer.
"""
