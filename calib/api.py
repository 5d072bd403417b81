"""The pieces of the calibration engine: problem, parameters, residuals, solvers, intervals and judge.

``deal_hw.calibrate`` puts them together. A program that needs another residual, another solver or a question
of its own takes the pieces: docs/how-to/own-calibration-engine.md does so with a pendulum.

    recordings, model  ->  Problem  ->  Shooting or OwnResidual  ->  minimise  ->  uncertainty_at, HeldOut
"""

from __future__ import annotations

from deal_hw.calib.data.parts import longest_windows, part_of, samples_in
from deal_hw.calib.data.problem import Member, Problem
from deal_hw.calib.data.window_data import MemberPrediction, WindowData
from deal_hw.calib.fit.intervals import Uncertainty, uncertainty, uncertainty_at, with_rows
from deal_hw.calib.fit.null_space import NullSpace, null_space
from deal_hw.calib.fit.output_error import OutputErrorFit, Recipe, fit_output_error
from deal_hw.calib.fit.own_residual import OwnResidual, Residual
from deal_hw.calib.fit.refinement import Refined, at_parameters, refine, refined_at
from deal_hw.calib.fit.residual import Normal, Point, Shooting, value_bounds
from deal_hw.calib.fit.solver import Following, LeastSquares, SolverSettings, minimise
from deal_hw.calib.validation.metrics import HeldOut, HeldoutErrors
from deal_hw.parameters import Parameter, ParameterSpace
from deal_hw.sim.parameters import with_doubts
from deal_hw.sim.parameters.default_space import default_space
from deal_hw.sim.parameters.kind import Kind

__all__ = [
    "Following",
    "HeldOut",
    "HeldoutErrors",
    "Kind",
    "LeastSquares",
    "Member",
    "MemberPrediction",
    "Normal",
    "NullSpace",
    "OutputErrorFit",
    "OwnResidual",
    "Parameter",
    "ParameterSpace",
    "Point",
    "Problem",
    "Recipe",
    "Refined",
    "Residual",
    "Shooting",
    "SolverSettings",
    "Uncertainty",
    "WindowData",
    "at_parameters",
    "default_space",
    "fit_output_error",
    "longest_windows",
    "minimise",
    "null_space",
    "part_of",
    "refine",
    "refined_at",
    "samples_in",
    "uncertainty",
    "uncertainty_at",
    "value_bounds",
    "with_doubts",
    "with_rows",
]
