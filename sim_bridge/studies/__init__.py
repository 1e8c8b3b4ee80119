"""Many flights: campaigns, comparisons of controllers, tuning of gains.

A plan of flights (campaign.py, variants.py) is flown in parallel (campaign_runner.py), measured (metrics.py) and summed up
with confidence intervals (statistics.py, report.py).
"""
