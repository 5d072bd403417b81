"""The safety module, which every command passes, and the passive command at the end of a run."""
