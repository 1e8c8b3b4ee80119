"""The synthetic camera: from the robots' state to a picture, through the water's surface.

Rays and optics (rays.py, optics.py, water_optics.py) place textures (sprites, plates, floor) in layers; renderer.py composes
them, sensor_noise.py and faults.py spoil them. ideal_localizer.py gives poses without a picture.
"""
