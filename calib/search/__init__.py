"""Searches that go generation by generation."""
