"""Accuracy of the localizer against ground truth, and age of its poses.

runner.py reads a recording and its truth and runs the localizer on it; offline.py writes the poses of a video to a table;
metrics.py makes tables of errors; latency.py
measures camera and computer.
"""
