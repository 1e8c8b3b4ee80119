"""The simulated robots and the water around them. Pure.

Pulses -> forces -> motion -> readings. Each physical part has a module with its equations and constants: actuators.py,
battery.py, currents_waves.py, contact.py, rigid_body.py, sensors.py. motion.py puts the equations together and integrates them
for one robot after the other, on the records of vectors.py and robot_state.py. fleet.py holds a fleet's state and steps it;
random_streams.py seeds every random part by itself.
"""
