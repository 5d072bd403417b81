"""Episodes and datasets: written as MCAP during a run, repaired after a kill, checked, read."""
