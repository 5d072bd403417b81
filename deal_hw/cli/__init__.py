"""The verbs of `deal-hw`, one module each: the only place where the parts are put together.

:mod:`deal_hw.cli.main` holds the table of verbs and imports the one that was asked for.
"""
