"""The package that the four processes share: messages, topics, configuration, frames, the bus, the thruster link."""
