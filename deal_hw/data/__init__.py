"""Recordings: our own episodes, those of others as they are imported, checks of both, and export."""
