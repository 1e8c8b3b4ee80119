"""From estimate and reference to the wrench: the nonlinear MPC, and the laws that it is compared with.

nonlinear/ is the controller that robots fly with. controller.py runs a step of the others: heading (heading.py) and a law that
law.py builds: the article's MPC (mpc.py on linearisation.py), or one of baselines/. active_set.py solves both quadratic
programs, osqp_fallback.py those that it cannot. any_controller.py names the one for the experiment; live_tuning.py changes
gains in flight.
"""
