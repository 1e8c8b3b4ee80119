"""One nonlinear MPC: a condensed quadratic program a step, linearised about the last plan moved on by one step.

prediction.py says where commands lead (and by how much that changes with them), program.py what that costs and how to
improve it, obstacle_rows.py what has to be kept clear, first_guess.py other ways to begin, tuning.py all weights as formulas.
nonlinear_controller.py runs a step.
"""
