"""The verbs of `deal-hw`, one module each; only this package joins all the parts.

:mod:`deal_hw.cli.verbs` holds the table of verbs; :mod:`deal_hw.cli.main` imports the requested one.
"""
