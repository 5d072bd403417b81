"""Supervisor and control process: heartbeat, claims, scheduling, and what they tell each other."""
