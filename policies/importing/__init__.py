"""Policies that other trainers exported: what they say of themselves, and their networks as our files."""
