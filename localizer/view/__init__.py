"""Pictures for people, made beside the localizer's loop, which never waits for them.

The newest frame and poses go to a worker thread (worker.py), which draws (overlay.py, drawing.py), publishes (preview.py),
serves (mjpeg_server.py on local_server.py, as does the camera's setup) and encodes the log's video (video_encoder.py).
"""
