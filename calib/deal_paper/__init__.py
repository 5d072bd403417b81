"""DEAL as published, line by line."""
