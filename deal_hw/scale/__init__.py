"""Tasks on many processors: where `--ray` says.

Nothing here loads Ray before tasks are to be spread.
"""
