"""Recordings: deal-hw's own episodes, imports from other formats, checks of both, and export."""
