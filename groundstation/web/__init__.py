"""The operator's page: what it is told, what it may ask for, and who may look.

server.py serves the page and one WebSocket for each browser; snapshot.py and scene.py are what goes out (client_hub.py),
protocol.py
is what may come in. live_backend.py stands on a running station, replay_backend.py on a log.
"""
