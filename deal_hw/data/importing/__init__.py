"""Recordings of any robot: CSV, NPZ, MCAP and LeRobot files become :class:`~deal_hw.types.Trajectory`.

A source reads a file into named channels, a column map says which channel is what, a
:class:`~deal_hw.data.importing.table.Table` holds the result in SI units, and
:mod:`deal_hw.data.importing.grid` puts it on a uniform time grid. Start at
:func:`deal_hw.data.importing.load.load_tables`.
"""
