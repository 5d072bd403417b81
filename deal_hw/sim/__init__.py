"""MuJoCo: model assembly, parameter kinds and the batched simulator. The only package that imports mujoco."""
