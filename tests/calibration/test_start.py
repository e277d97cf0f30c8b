"""The first guess: some per cent off at most, whatever camera it is."""

import math

import numpy as np
import pytest
import torch

from tests import head_body
from torchptz.calibration import parameters as at
from torchptz.calibration.parameters import Layout
from torchptz.calibration.priors import Priors, known_of
from torchptz.calibration.problem import Problem
from torchptz.calibration.start import start_of
from torchptz.observations import Observations

POWERS = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)

CAMERAS = {
    "usual": head_body.body(0),
    "barrel": head_body.body(1, barrel=(0.1, 0.25, 0.1)),
    "pincushion": head_body.body(1, barrel=(-0.1, -0.05, 0.0)),
    "one zoom": head_body.body(2, zooms=(1.0,)),
    "long end": head_body.body(2, zooms=(25.0,)),
    "wide": head_body.body(3, wide=350.0),
    "long": head_body.body(3, wide=3000.0),
    "far below": head_body.body(4, ray=np.array([[0.3, math.radians(75)]])),
    "behind": head_body.body(5, ray=np.array([[math.pi, 0.2]])),
    "two features": head_body.body(6, ray=np.array([[-1.0, 0.1], [1.2, 0.6]]), features=2),
    "head off": head_body.body(7, tilt_zero=0.05, boresight=-0.05, roll=0.1),
    "sensor on its side": head_body.body(7, roll=math.pi / 2),
    "aspect": head_body.body(8, aspect=1.2),
}


def started(seen, **priors):
    problem = Problem.from_observations(seen, POWERS)
    known = known_of(Priors(**priors), seen, problem.layout, problem.used)
    return problem.layout.split(start_of(problem, seen, known))


@pytest.mark.parametrize("made", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("jitter", [0.0, 1.0])
class TestGuess:
    def test_focal_lengths(self, made, jitter):
        seen = head_body.observed(made, jitter=jitter, draws=2)
        zooms, _, _ = started(seen, pixel_aspect=made.aspect)
        focal = zooms[..., at.LOG_FOCAL].exp().numpy()
        # The barrel of a wide end makes it look shorter: that much the iteration mends.
        assert np.abs(np.log(focal / made.focal)).max() < 0.25

    def test_rays(self, made, jitter):
        seen = head_body.observed(made, jitter=jitter, draws=2)
        _, _, features = started(seen, pixel_aspect=made.aspect)
        axes = np.array(
            [made.tilt_zero, made.boresight, 0.01 + abs(made.roll) * 0.3 / made.zooms[-1]]
        )
        off = head_rays(features[0, :, :2].numpy()) - head_rays(made.ray)
        assert np.linalg.norm(off, axis=-1).max() < 2 * np.linalg.norm(axes)


def head_rays(angles):
    pan, tilt = angles.T
    return np.stack([-np.sin(pan) * np.cos(tilt), np.sin(tilt), np.cos(pan) * np.cos(tilt)], -1)


class TestPriors:
    def test_a_focal_length_that_is_told_is_the_start(self):
        seen = head_body.observed(CAMERAS["usual"])
        zooms, _, _ = started(seen, focal_length=torch.tensor([[700.0, 3600.0, math.nan]]))
        found = zooms[0, :, at.LOG_FOCAL].exp()
        np.testing.assert_allclose(found[:2], [700, 3600])
        assert found[2] == pytest.approx(CAMERAS["usual"].focal[2], rel=0.1)

    def test_everything_else_starts_at_its_mean(self):
        seen = head_body.observed(CAMERAS["usual"])
        given = {"pupil_m": 0.07, "distance_m": 6.0, "pixel_aspect": 1.1}
        zooms, head, features = started(seen, **given)
        assert zooms[0, :, 8].tolist() == [0.07] * 3
        assert zooms[0, :, 1:8].abs().max() == 0
        assert features[0, 0, 2] == pytest.approx(1 / 6)
        middle = [(head_body.SIZE[0] - 1) / 2, (head_body.SIZE[1] - 1) / 2]
        np.testing.assert_allclose(head[0], [*middle, 0, 0, 0, 1, 1, math.log(1.1), 0, 0])


LITTLE = {
    "one look": ([[0, 0]], [[100, 100]], [1]),
    "nothing found": ([[0, 0], [0.1, 0]], [[np.nan] * 2] * 2, [1, 2]),
    "one pose": ([[0, 0]] * 5, [[100, 100]] * 5, [1] * 5),
    "the same pixel": ([[0, 0], [0.1, 0], [0.2, 0.1]], [[100, 100]] * 3, [1] * 3),
    "less than a step": ([[0, 0], [1e-9, 0]], [[100, 100], [300, 300]], [1, 1]),
    "every look another zoom": ([[0, 0], [0.1, 0]], [[100, 100], [300, 300]], [1, 2]),
}


class TestLittle:
    """What tells nothing starts somewhere, at numbers."""

    def one(self, poses, pixels, zoom):
        count = len(poses)
        looks = {
            "camera": "little",
            "image_size": (640, 480),
            "quantum": (0.001, 0.001),
            "zoom": np.array(zoom, float),
            "commanded": np.array(poses, float),
            "read": np.array(poses, float),
            "pixel": np.array(pixels, float),
            "sigma": np.full(count, 0.1),
        }
        return Observations.from_lists([looks])

    @pytest.mark.parametrize("case", LITTLE.values(), ids=LITTLE)
    def test_starts_somewhere(self, case):
        parts = started(self.one(*case))
        assert all(bool(part.isfinite().all()) for part in parts)
        zooms = parts[0]
        assert bool((zooms[..., at.LOG_FOCAL].exp() > 10).all())

    def test_a_zoom_without_its_own_follows_the_others(self):
        """By the magnifications as the device names them."""
        made = CAMERAS["usual"]
        looks = head_body.looks(made, head_body.plan(made))[0]
        lone = looks["zoom"] == 5
        lone &= np.cumsum(lone) != 20
        looks["pixel"] = np.where(lone[:, None], np.nan, looks["pixel"])
        zooms, _, _ = started(Observations.from_lists([looks]))
        focal = zooms[0, :, at.LOG_FOCAL].exp().numpy()
        np.testing.assert_allclose(focal, made.focal, rtol=0.1)

    def test_padding_and_other_cameras_do_not_matter(self):
        few = head_body.looks(CAMERAS["one zoom"], head_body.plan(CAMERAS["one zoom"]))[0]
        many = head_body.looks(CAMERAS["two features"], head_body.plan(CAMERAS["two features"]))[0]
        alone = started(Observations.from_lists([few]))
        together = started(Observations.from_lists([few, many]))
        torch.testing.assert_close(together[0][0, 0], alone[0][0, 0], rtol=0, atol=1e-12)
        torch.testing.assert_close(together[1][0], alone[1][0], rtol=0, atol=1e-12)
        torch.testing.assert_close(together[2][0, 0], alone[2][0, 0], rtol=0, atol=1e-12)
        assert Layout(3, 2, 3).size == sum(part[0].numel() for part in together)
