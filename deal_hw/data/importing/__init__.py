"""Recordings of any robot: files of many kinds become :class:`~deal_hw.types.Trajectory`.

A source reads a file into named channels. A column map gives each channel its meaning. A
:class:`~deal_hw.data.table.Table` contains the result in SI units, and
:mod:`deal_hw.data.importing.grid` puts it on a uniform time grid. Start at
:func:`deal_hw.data.importing.load.load_tables`.
"""
