"""Calibrations that several test modules look at."""

import numpy as np
import pytest

import torchptz as tp
from tests import head_body

PRIORS = tp.Priors(distance_m=12.0, pupil_sigma_m=0.001)


@pytest.fixture(scope="session")
def fleet():
    """Three cameras that have little in common: bodies and their looks."""
    bodies = [
        head_body.body(0, tilt_zero=0.004, boresight=-0.006, roll=0.01),
        head_body.body(1, zooms=(1.0, 4.0), ray=np.array([[-0.5, 0.1], [0.6, 0.6]]), features=2),
        head_body.body(2, zooms=(2.0,), backlash=(1e-3, 1e-3)),
    ]
    looks = [
        head_body.looks(one, head_body.plan(one, grid=(7, 5)), seed=7, jitter=0.3, name=f"body {n}")
        for n, one in enumerate(bodies)
    ]
    return bodies, [one[0] for one in looks]


@pytest.fixture(scope="session")
def calibrated(fleet):
    """The fleet's calibration."""
    return tp.calibrate(tp.Observations.from_lists(fleet[1]), PRIORS)
