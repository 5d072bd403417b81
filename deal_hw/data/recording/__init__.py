"""Episodes: written as MCAP while they happen, repaired after a kill, checked, read back; datasets."""
