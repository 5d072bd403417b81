"""Damaged and hostile inputs for every reader; run by ``tools/fuzz_files.py``."""
