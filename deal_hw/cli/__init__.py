"""The verbs of `deal-hw`, one module each; only this package joins all the parts.

:mod:`deal_hw.cli.main` holds the table of verbs and imports the requested one.
"""
