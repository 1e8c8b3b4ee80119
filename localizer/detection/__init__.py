"""Detection in one frame: markers, image regions around robots, correlation responses, obstacles.

Regions of the raw picture (image_regions.py) go to the marker reader (fiducials.py) and to the correlation filter
(correlation_filter.py). obstacles.py compares the picture with a learnt background (background_model.py) and follows the
foreground over time (blob_tracker.py).
"""
