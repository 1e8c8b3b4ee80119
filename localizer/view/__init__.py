"""Pictures for people, made beside the localizer's loop and never in its way.

The newest frame and poses go to a worker thread (worker.py), which draws (overlay.py), publishes (preview.py), serves
(mjpeg_server.py) and encodes the log's video (video_encoder.py).
"""
