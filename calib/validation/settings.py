"""Which checks follow a fit; the checks themselves are loaded after it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Validation:
    """Which checks follow a refinement."""

    local_first: bool = True
    """Refine the nominal values first; where that explains the recordings there is no search."""

    cross_validation: bool = True
    """Choose among candidate fits by their predictions of data that they left out (`output-error`)."""

    split_half: bool = True
    """Refine two halves of the data alone and compare."""

    physics_step: bool = True
    """Predict with half the physics step; intervals include the step's shift."""

    diagnosis: bool = True
    """Name causes of an unexplained residual."""

    laws: bool = True
    """Take a law that the model lacks into the fit where it predicts better; otherwise it is only named."""

    thorough: bool = False
    """Run checks to their end where they take more physics steps than the fits."""
