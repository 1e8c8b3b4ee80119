"""The operator's page: what it is told, what it may ask for, and who may look.

server.py serves the page and one WebSocket for each browser. snapshot.py and scene.py make what goes out (client_hub.py);
protocol.py reads what comes in. live_backend.py stands on a running station, replay_backend.py on a log. run_desk.py lists
other runs and says what became of one, experiment_editor.py saves an edited experiment, alarms.py finds what is wrong.
"""
