"""What the four processes agree on: messages, topics, frames, vehicle and experiment files, the bus, the thruster link."""
