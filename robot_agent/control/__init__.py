"""From estimate and reference to the wrench: the ESO-MPC, and the laws that it is compared with.

controller.py runs a step: heading (heading.py), linear model over the horizon (linearisation.py), quadratic program (mpc.py;
solved by active_set.py or qp.py). law.py builds the control law that the experiment names; live_tuning.py changes gains in
flight.
"""
