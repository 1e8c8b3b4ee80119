"""The simulated robots and the water around them. Pure.

Pulses -> forces -> motion (kernels.py: all equations, compiled) -> readings (sensors.py). The constants of the equations come
from actuators.py, battery.py, rigid_body.py, currents_waves.py and contact.py. fleet.py holds a fleet's state and steps all
robots at once; random_streams.py seeds every random part by itself.
"""
