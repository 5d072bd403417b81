"""The tables of `deal-hw bench`: cells to run, rows to store, summaries.

A bench returns its cells, and :func:`deal_hw.bench.rows.run_cells` runs the missing ones.
"""
