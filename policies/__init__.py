"""Policies: training environments and trainers (torch), and a runtime for deployment.

The runtime, :mod:`deal_hw.policies.onnx_runtime`, needs neither torch nor MuJoCo.
"""
