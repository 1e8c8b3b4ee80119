"""From an experiment to trajectories that robots can fly, and from under way to others. Pure.

Geometry (paths.py, route_planner.py) -> time (time_scaling.py) -> nodes of the formation (formation.py) -> checks
(feasibility.py). replanning.py, rest_to_rest.py and prioritized_planning.py plan from where robots are.
"""
