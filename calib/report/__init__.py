"""The verdict on a result, and its report: one HTML page that needs nothing beside it."""
