"""From a log to figures of merit and a verdict. Pure.

Messages are aligned on one clock (alignment.py, series.py), measured (metrics.py) and judged (acceptance.py); results.py is
what result.json holds, measures.py what a campaign keeps of it.
"""
