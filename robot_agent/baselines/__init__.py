"""The control laws that the ESO-MPC is compared with. Start with feedback.py; docs/baselines.md has equations and figures."""
