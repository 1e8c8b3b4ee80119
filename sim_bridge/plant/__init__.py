"""The simulated robots and the water around them. Pure.

Pulses -> forces (actuators.py, battery.py) -> motion (rigid_body.py, hydrodynamics.py, currents_waves.py, contact.py) ->
readings (sensors.py). fleet.py steps all robots at once; random_streams.py seeds every random part by itself.
"""
