"""Every status by a camera that deserves it, and by nothing else."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import torchptz as tp
from tests import head_body
from tests.calibration.conftest import PRIORS
from torchptz.calibration.verdict import statuses
from torchptz.observations import Observations


def looks(seed=1, grid=(7, 5), **changed):
    """One camera with two zooms."""
    made = head_body.body(seed, zooms=(1.0, 5.0), **changed)
    return head_body.looks(made, head_body.plan(made, grid=grid))[0]


def names(*cameras, **how):
    """Names of the statuses, camera by camera."""
    calibration = tp.calibrate(Observations.from_lists(cameras), how.pop("priors", PRIORS), **how)
    return [[status.name for status in row] for row in calibration.status]


def thinned(one, zoom, keep):
    """Only the first few looks at a zoom found the feature."""
    own = one["zoom"] == zoom
    lost = own & (np.cumsum(own) > keep)
    return {**one, "pixel": np.where(lost[:, None], np.nan, one["pixel"])}


def wrong(one, share, seed=0):
    """Some detections anywhere in the picture."""
    rng = np.random.default_rng(seed)
    where = (
        rng.uniform(8, 1, one["pixel"].shape) if False else rng.uniform(10, 530, one["pixel"].shape)
    )
    bad = rng.random(len(where)) < share
    return {**one, "pixel": np.where(bad[:, None] & ~np.isnan(one["pixel"]), where, one["pixel"])}


class TestReached:
    def test_ok(self):
        assert names(looks()) == [["OK", "OK"]]

    @pytest.mark.parametrize("keep", [1, 3, 4])
    def test_too_few_looks_at_a_zoom(self, keep):
        """9 unknowns: the other zoom is none the worse for it."""
        assert names(thinned(looks(), 1.0, keep)) == [["TOO_FEW_LINES", "OK"]]

    def test_nothing_found_at_a_zoom(self):
        assert names(thinned(looks(), 1.0, 0)) == [["TOO_FEW_LINES", "OK"]]

    def test_nothing_found_at_all(self):
        one = looks()
        one["pixel"] = np.full_like(one["pixel"], np.nan)
        assert names(one) == [["TOO_FEW_LINES", "TOO_FEW_LINES"]]

    def test_too_many_wrong_detections_at_one_zoom(self):
        one = looks(grid=(9, 7))
        bad = wrong(one, 0.45)
        own = (one["zoom"] == 1)[:, None]
        assert names({**one, "pixel": np.where(own, bad["pixel"], one["pixel"])}) == [
            ["OUTLIERS", "OK"]
        ]

    @pytest.mark.parametrize("share", [0.6, 1.0])
    def test_most_detections_wrong(self, share):
        found = names(wrong(looks(grid=(9, 7)), share))[0]
        assert set(found) <= {"OUTLIERS", "INCONSISTENT"}

    @pytest.mark.parametrize("change", [(-1, 1), (1, -1), (-1, -1), (2, 1), (57.3, 57.3)])
    def test_wrong_signs_and_units(self, change):
        one = looks()
        turned = {**one, "read": one["read"] * change, "commanded": one["commanded"] * change}
        assert names(turned) == [["INCONSISTENT", "INCONSISTENT"]]

    def test_swapped_axes(self):
        one = looks()
        swapped = {name: one[name][:, ::-1].copy() for name in ("read", "commanded")}
        assert names({**one, **swapped}) == [["INCONSISTENT", "INCONSISTENT"]]

    def test_a_lens_that_the_powers_cannot_follow(self):
        barrel = (0.0, 0.0, 0.0, 0.0, 0.0, 0.5)
        one = looks(powers=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0), barrel=barrel, grid=(9, 7))
        assert names(one)[0][0] == "MISFIT"

    def test_looks_at_the_middle_only(self):
        one = looks(grid=(11, 9))
        middle = np.array(one["image_size"]) / 2
        far = np.abs(one["pixel"] - middle).max(1) > 100
        out = np.where((far & (one["zoom"] == 1))[:, None], np.nan, one["pixel"])
        assert names({**one, "pixel": out}) == [["DISTORTION_UNOBSERVABLE", "OK"]]

    def test_one_pose(self):
        one = looks()
        still = {
            name: np.tile(one[name][:1], (len(one["read"]), 1)) for name in ("read", "commanded")
        }
        same = np.tile(one["pixel"][40:41], (len(one["read"]), 1)) + one["pixel"] * 1e-4
        found = names({**one, **still, "pixel": same})
        assert found == [["DISTORTION_UNOBSERVABLE", "DISTORTION_UNOBSERVABLE"]]

    def test_a_lens_that_folds_in_the_picture(self):
        """r (1 - 0.27 r^2) folds at 1.11, the corners lie at 1.24; nothing is seen beyond 0.9."""
        made = head_body.body(1, zooms=(1.0, 5.0))
        made = replace(made, coefficients=np.array([[0, -0.27, 0], [0, 0.01, 0]]))
        one = head_body.looks(made, head_body.plan(made, grid=(9, 7)))[0]
        radius = np.linalg.norm(one["pixel"] - made.center[0], axis=1) / (head_body.SIZE[0] / 2)
        beyond = (radius > 0.9) & (one["zoom"] == 1)
        one["pixel"] = np.where(beyond[:, None], np.nan, one["pixel"])
        assert names(one)[0] == ["NOT_MONOTONIC", "OK"]

    def test_an_iteration_that_did_not_end(self, calibrated):
        """From where it could go on: no camera here is known to do that."""
        seen = torch.full_like(calibrated.exists, 99, dtype=torch.long)
        ended, strange = torch.tensor([True, False, True]), torch.tensor([False] * 3)
        table = statuses(calibrated, calibrated, seen, seen, ended, strange)
        assert [[status.name for status in row] for row in table] == [
            ["OK", "OK", "OK"],
            ["NOT_CONVERGED", "NOT_CONVERGED", "OK"],
            ["OK", "OK", "OK"],
        ]


class TestTable:
    def test_zooms_that_a_camera_does_not_have_are_ok(self, calibrated):
        assert [[status.name for status in row] for row in calibrated.status] == [["OK"] * 3] * 3

    def test_the_most_basic_failure_first(self, calibrated):
        """Few looks, of which most are outliers, of a camera that did not converge."""
        seen = torch.full_like(calibrated.exists, 3, dtype=torch.long)
        kept = torch.zeros_like(seen)
        no = torch.tensor([False] * 3)
        table = statuses(calibrated, calibrated, seen, kept, no, ~no)
        assert table[0][0].name == "TOO_FEW_LINES"
        table = statuses(calibrated, calibrated, 10 * seen, kept, no, ~no)
        assert table[0][0].name == "OUTLIERS"
        table = statuses(calibrated, calibrated, 10 * seen, 10 * seen, no, ~no)
        assert table[0][0].name == "INCONSISTENT"
        table = statuses(calibrated, calibrated, 10 * seen, 10 * seen, no, no)
        assert table[0][0].name == "NOT_CONVERGED"

    @pytest.mark.parametrize(("kept", "name"), [(4, "TOO_FEW_LINES"), (5, "OK")])
    def test_outliers_do_not_count(self, calibrated, kept, name):
        """Of 6 looks 4 inliers are 8 coordinates for 9 unknowns."""
        seen = torch.full_like(calibrated.exists, 6, dtype=torch.long)
        no = torch.tensor([False] * 3)
        table = statuses(calibrated, calibrated, seen, kept + 0 * seen, ~no, no)
        assert table[0][0].name == name

    def test_says_what_to_do(self):
        assert "signs" in str(tp.Status.INCONSISTENT.value)
