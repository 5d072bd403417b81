"""Fakes for tests and tools: robots, wires, policies and recordings with chosen behaviour."""
