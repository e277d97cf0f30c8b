"""The estimator: line patterns in, lenses out. One step of the algorithm a file."""

from torchptz.estimation.estimate import Fit, estimate
from torchptz.estimation.principal_point import estimate_magnification, estimate_principal_point
from torchptz.estimation.status import Status

__all__ = ["Fit", "Status", "estimate", "estimate_magnification", "estimate_principal_point"]
