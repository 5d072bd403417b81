"""Checks of a fit on parts of the data, on other models, and on motion that it has not seen."""
