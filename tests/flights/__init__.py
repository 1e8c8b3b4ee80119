"""Numeric flights that tests look at and benchmarks count: nothing here imports from benchmarks.

scene_flights.py     an experiment flown whole in this process, held against its references
encounters.py        robots in one another's way, from drawn starts; broken_thrusters.py: a thruster that breaks
cells.py             cells of a grid; `draw` makes the n-th flight of a cell, always the same, as settings of an experiment
grid_flights.py      flies it (water.py: fleet and plant that can be held fast, blinded, swept away; vehicles.py: other robots)
figures.py           figures of the flight, from the plant's truth (claims.py: the observer's own idea of its errors)
"""
