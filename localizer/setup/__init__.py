"""Setting up a camera in a browser: `localizer setup`.

A source's frames (camera_feed.py) give figures (picture_figures.py), views of a board (lens_step.py) and places of survey
points (survey_step.py). session.py holds what was done and what it comes to, by the functions of `localizer calibrate`;
experiment_file.py shows and saves the difference; server.py is the page's server, and static/ the page.
"""
