"""Policies: training environments and trainers (torch), and a runtime for deployment that needs neither torch nor MuJoCo."""
