"""The tables of figures that `deal-hw bench` prints: cells to run, rows to keep, sentences about them.

A bench returns its cells, and :func:`deal_hw.bench.rows.run_cells` runs those that are not done yet.
"""
