"""Studies of many flights: campaigns, comparisons of controllers, tuning of gains.

campaign.py lists the flights of a campaign, campaign_runner.py flies them in parallel (worker_pool.py). campaign_flight.py is
one flight; the ground station judges it (groundstation/analysis). dependence.py, statistics.py and report.py sum up with
confidence intervals. comparison.py flies controllers on the same seeds; gain_tuning.py searches gains on such flights.
"""
