"""From estimate and reference to the wrench: the ESO-MPC, and the laws that it is compared with.

controller.py leads a step: heading (heading.py), linear model over the horizon (linearisation.py), quadratic program (mpc.py,
qp.py). law.py makes the law that the experiment names; gains change in flight through live_tuning.py.
"""
