"""What one picture shows: markers, patches around robots, filter responses, obstacles.

Regions of the raw picture (image_regions.py) go to the marker reader (fiducials.py) and the correlation filter
(correlation_filter.py); obstacles.py finds what does not belong to the water (background_model.py) and follows it.
"""
