"""Pages for people: a run's report, runs side by side, comparisons of controllers.

Aligned series and results become figures (figures*.py, plotting.py) and one self-contained page (report.py, templates/).
"""
