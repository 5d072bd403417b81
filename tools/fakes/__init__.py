"""Fakes for tests and tools: robots, wires, policies and recordings that are made as they are wanted."""
