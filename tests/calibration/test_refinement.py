"""The optimum against scipy on the explicit problem, with the poses of all stops as unknowns."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from tests import head_body
from torchptz.calibration import parameters as at
from torchptz.calibration.marginal import Noise
from torchptz.calibration.priors import Priors, known_of
from torchptz.calibration.problem import Problem
from torchptz.calibration.refinement import _returns, held_out, inliers, inverse, refine

PRIORS = Priors(distance_m=12.0, pupil_sigma_m=0.001, focal_length=torch.tensor([[738.0, 3690.0]]))
NO_PLAY = replace(PRIORS, backlash_sigma=0.0)


class ErrorsInVariables:
    """Errors in the picture and of the head, and priors, as one sum of squares for scipy.

    Unknowns: those of the camera that are free, then what every stop erred by, in its sigmas.
    """

    def __init__(self, made, looks, known, head_sigma):
        self.made, self.head = made, np.asarray(head_sigma, float)
        self.seen = np.isfinite(looks["pixel"]).all(1)
        self.pixel = looks["pixel"][self.seen]
        self.sigma = looks["sigma"][self.seen, None]
        self.commanded = looks["commanded"]
        self.stop = head_body.stops_of(self.commanded)[self.seen]
        self.stops = int(self.stop.max()) + 1
        self.zoom = np.searchsorted(made.zooms, looks["zoom"])[self.seen]
        self.feature = looks["feature"][self.seen]
        self.mean, sigma = known.mean[0].numpy(), known.sigma[0].numpy()
        self.free = sigma > 0
        self.prior = sigma[self.free]

    def theta(self, x):
        theta = self.mean.copy()
        theta[self.free] = x[: self.free.sum()]
        return theta

    def pixels(self, own, errors):
        made = head_body.body_of(self.theta(own), self.made)
        load = head_body.behind(self.commanded, np.array(made.backlash))[self.seen]
        return made.see(load + errors[self.stop], self.zoom, self.feature)

    def parts(self, x):
        own, errors = np.split(x, [self.free.sum()])
        return own, errors.reshape(-1, 2) * self.head if errors.size else np.zeros((self.stops, 2))

    def residual(self, x):
        own, errors = self.parts(x)
        seen = (self.pixels(own, errors) - self.pixel) / self.sigma
        prior = (own - self.mean[self.free]) / self.prior
        return np.concatenate([seen.ravel(), prior, x[len(own) :]])

    def jacobian(self, x):
        """Central differences; a stop's errors move its own looks only."""
        own, errors = self.parts(x)
        rows, count = self.pixel.size, len(own)
        out = np.zeros((rows + len(x), len(x)))
        out[rows:] = np.diag(np.concatenate([1 / self.prior, np.ones(len(x) - count)]))
        for place in range(count):
            step = np.zeros(count)
            step[place] = 1e-6 * max(1.0, abs(own[place]))
            moved = self.pixels(own + step, errors) - self.pixels(own - step, errors)
            out[:rows, place] = (moved / (2 * step[place]) / self.sigma).ravel()
        for axis in range(2) if len(x) > count else ():
            step = 1e-7 * np.eye(2)[axis]
            moved = self.pixels(own, errors + step) - self.pixels(own, errors - step)
            moved = moved / 2e-7 / self.sigma * self.head[axis]
            for look, stop in enumerate(self.stop):
                out[2 * look : 2 * look + 2, count + 2 * stop + axis] = moved[look]
        return out

    def solve(self, start):
        """Unknowns (T,) at the optimum, and the covariance of those that are free."""
        errors = np.zeros(2 * self.stops if self.head.any() else 0)
        tight = {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14}
        begun = np.concatenate([start[self.free], errors])
        found = least_squares(self.residual, begun, self.jacobian, method="lm", **tight)
        covariance = np.linalg.inv(found.jac.T @ found.jac)
        count = self.free.sum()
        return self.theta(found.x), covariance[:count, :count]

    def marginal_step(self, theta, sigma):
        """Newton's step of the marginalised problem at theta, its covariance held; dense."""
        own, errors = theta[self.free], np.zeros((self.stops, 2))
        jacobian = self.jacobian(np.concatenate([own, errors.ravel()]))[: self.pixel.size]
        columns, poses = np.split(jacobian, [len(own)], axis=1)
        covariance = np.eye(len(columns)) + poses @ poses.T
        away = ((self.pixel - self.pixels(own, errors)) / self.sigma).ravel()
        information = np.diag(self.prior**-2.0)
        matrix = columns.T @ np.linalg.solve(covariance, columns) + information
        right = columns.T @ np.linalg.solve(covariance, away)
        right += information @ (self.mean[self.free] - own)
        return np.linalg.solve(matrix, right) / sigma


def setup(reading, seed=0, priors=PRIORS, draws=1, **changed):
    """A small camera: its looks, the problem with its noise known, and what scipy makes of it."""
    made = head_body.body(3, zooms=(1.0, 5.0), **changed)
    planned = head_body.plan(made, quantum=(0.0, 0.0), grid=(4, 3), tracks=4)
    looks = head_body.looks(made, planned, seed, draws, reading=reading)
    seen = head_body.Observations.from_lists(looks)
    powers = torch.tensor(made.powers, dtype=torch.float64)
    problem = Problem.from_observations(seen, powers)
    known = known_of(priors, seen, problem.layout, problem.used)
    head = torch.full((draws, 2), max(reading, 1e-9), dtype=torch.float64) ** 2
    noise = Noise(head, torch.ones(draws, dtype=torch.float64))
    explicit = ErrorsInVariables(made, looks[0], known, (reading, reading))
    return made, problem, known, noise, explicit


def start_of(made, known):
    """Near the truth, not at it; what is held is held at its mean."""
    theta = head_body.theta_of(made)
    theta = theta + 1e-3 * torch.cos(torch.arange(theta.shape[1]))
    return torch.where(known.free, theta, known.mean)


class TestOptimum:
    def test_of_a_head_that_reads_the_truth_is_scipys(self):
        made, problem, known, noise, explicit = setup(0.0, backlash=(1e-3, 2e-3))
        refined = refine(problem, start_of(made, known), known, noise)
        assert bool(refined.converged)
        theta, covariance = explicit.solve(head_body.theta_of(made)[0].numpy())
        sigma = np.sqrt(np.diag(covariance))
        off = (refined.theta[0].numpy() - theta)[explicit.free] / sigma
        assert np.abs(off).max() < 1e-3
        found = refined.covariance[0].numpy()[np.ix_(explicit.free, explicit.free)]
        np.testing.assert_allclose(
            found / np.outer(sigma, sigma), covariance / np.outer(sigma, sigma), atol=2e-3
        )

    @pytest.mark.parametrize(("reading", "most"), [(1e-4, 0.1), (3e-4, 0.4)])
    def test_of_a_head_that_errs_is_scipys_but_for_the_metric(self, reading, most):
        """Scipy's sum of squares changes with how much the readings count, here that is held.

        All 26 unknowns together are off by 0.03 of a standard deviation at an error of 1e-4 rad,
        in the median of 25 draws, and by 0.2 at 1e-3.
        """
        made, problem, known, noise, explicit = setup(reading, priors=NO_PLAY)
        refined = refine(problem, start_of(made, known), known, noise)
        assert bool(refined.converged)
        theta, covariance = explicit.solve(head_body.theta_of(made)[0].numpy())
        off = (refined.theta[0].numpy() - theta)[explicit.free]
        assert math.sqrt(off @ np.linalg.solve(covariance, off)) < most
        found = refined.covariance[0].numpy()[np.ix_(explicit.free, explicit.free)]
        ratio = np.sqrt(np.diag(found) / np.diag(covariance))
        np.testing.assert_allclose(ratio, 1, atol=max(0.05 * reading / 1e-3, 1e-3))

    @pytest.mark.parametrize("reading", [1e-4, 1e-3])
    def test_solves_its_own_equations(self, reading):
        """At the solution a dense Newton step, by finite differences, leads nowhere."""
        made, problem, known, noise, explicit = setup(reading, 1, NO_PLAY)
        refined = refine(problem, start_of(made, known), known, noise)
        sigma = refined.covariance[0].diagonal().sqrt().numpy()[explicit.free]
        step = explicit.marginal_step(refined.theta[0].numpy(), sigma)
        assert np.abs(step).max() < 1e-3

    @pytest.mark.parametrize("heavy_tails", [False, True])
    def test_without_noise_it_is_the_truth(self, heavy_tails):
        made = head_body.body(3, zooms=(1.0, 5.0), backlash=(1e-3, 1e-3), tilt_zero=0.01, roll=0.02)
        planned = head_body.plan(made, grid=(4, 3), tracks=4)
        seen = head_body.observed(made, planned, sigma=0.0)
        powers = torch.tensor(made.powers, dtype=torch.float64)
        problem = Problem.from_observations(seen, powers)
        truth = head_body.theta_of(made)
        known = known_of(PRIORS, seen, problem.layout, problem.used)
        # Priors about the truth, so that they do not pull away from it.
        known = replace(known, mean=truth)
        noise = Noise(torch.full((1, 2), 1e-12).double(), torch.ones(1).double())
        refined = refine(problem, start_of(made, known), known, noise, heavy_tails=heavy_tails)
        sigma = refined.covariance[0].diagonal().sqrt()
        assert ((refined.theta - truth)[0].abs() <= 1e-2 * sigma).all()


class TestParts:
    def test_freedom_counts_what_the_data_determine(self):
        """Coordinates less unknowns, but those that priors tell: a held one counts nothing, one
        with a tight prior hardly anything."""
        made, problem, known, noise, explicit = setup(0.0)
        refined = refine(problem, start_of(made, known), known, noise)
        covariance = refined.covariance[0].numpy()[np.ix_(explicit.free, explicit.free)]
        determined = len(covariance) - (np.diag(covariance) / explicit.prior**2).sum()
        assert refined.freedom.item() == pytest.approx(2 * len(explicit.pixel) - determined)

    def test_cost_is_what_the_residuals_make(self):
        made, problem, known, noise, explicit = setup(0.0)
        refined = refine(problem, start_of(made, known), known, noise)
        squares = refined.residual[0].numpy()[explicit.seen] / explicit.sigma
        assert refined.cost.item() == pytest.approx((squares**2).sum(), rel=1e-3)

    def test_inliers_are_within_five_standard_deviations(self):
        made, problem, known, noise, _ = setup(0.0)
        far = problem.pixel.clone()
        far[0, 7] += torch.tensor([0.9, 0.0])
        refined = refine(problem, start_of(made, known), known, noise)
        moved = replace(refined, distance=refined.distance.clone())
        moved.distance[0, 3] = 25.1
        moved.distance[0, 4] = 24.9
        good = inliers(problem, moved)
        assert not bool(good[0, 3])
        assert bool(good[0, 4]) == bool(problem.used[0, 4])
        assert good.sum() == problem.used.sum() - 1

    def test_a_play_does_not_become_negative(self):
        made, problem, known, noise, _ = setup(0.0, draws=6)
        refined = refine(problem, start_of(made, known), known, noise)
        plays = problem.layout.split(refined.theta)[1][:, at.BACKLASH]
        assert bool((plays >= 0).all())
        assert bool((plays < 1e-3).all())
        assert bool(refined.converged.all())

    def test_what_is_held_stays(self):
        made, problem, known, noise, _ = setup(0.0, priors=replace(PRIORS, roll_sigma=0.0))
        theta = start_of(made, known)
        refined = refine(problem, theta, known, noise)
        held = ~known.free
        assert bool(held.any())
        torch.testing.assert_close(refined.theta[held], theta[held], rtol=0, atol=0)
        assert refined.covariance[0][held[0]].abs().max() == 0

    def test_outliers_do_no_harm_under_heavy_tails(self):
        made, problem, known, noise, _ = setup(0.0)
        found = refine(problem, start_of(made, known), known, noise).theta
        pixel = problem.pixel.clone()
        pixel[0, ::8] = torch.rand(pixel[0, ::8].shape).double() * problem.image_size
        wrong = replace(problem, pixel=pixel)
        heavy = refine(wrong, start_of(made, known), known, noise, heavy_tails=True)
        light = refine(wrong, start_of(made, known), known, noise)
        sigma = heavy.covariance[0].diagonal().sqrt().clamp_min(1e-12)
        near = ((heavy.theta - found)[0].abs() / sigma).median()
        assert near < 1.5
        assert ((light.theta - found)[0].abs() / sigma).median() > 10 * near

    def test_cameras_do_not_wait_for_each_other(self):
        """One that is at its optimum does not move with those that are not."""
        made, problem, known, noise, _ = setup(0.0, draws=3)
        theta = start_of(made, known)
        alone = refine(problem[1], theta[1:2], known[1], noise[1])
        theta[2] += 0.02
        together = refine(problem, theta, known, noise)
        torch.testing.assert_close(together.theta[1], alone.theta[0], rtol=1e-10, atol=1e-13)
        assert together.iterations[1] == alone.iterations[0]

    def test_nothing_seen(self):
        made, problem, known, noise, _ = setup(0.0)
        empty = problem.using(torch.zeros_like(problem.weight))
        refined = refine(empty, start_of(made, known), known, noise)
        torch.testing.assert_close(refined.theta, start_of(made, known), rtol=0, atol=0)
        assert not bool(refined.converged)


class TestAlgebra:
    def matrix(self, seed=0):
        generator = torch.Generator().manual_seed(seed)
        rows = torch.randn(2, 9, 6, generator=generator, dtype=torch.float64)
        # Unknowns of very different sizes, as pixels and radians are.
        size = 10.0 ** torch.arange(-6, 6, 2, dtype=torch.float64)
        return rows.mT @ rows * (size[:, None] * size)

    def test_inverse(self):
        matrix = self.matrix()
        found, failed = inverse(matrix)
        assert not bool(failed.any())
        size = matrix.diagonal(dim1=1, dim2=2).sqrt()
        whole = (found @ matrix) * size[:, :, None] / size[:, None]
        torch.testing.assert_close(
            whole, torch.eye(6).double().expand(2, -1, -1), rtol=0, atol=1e-9
        )

    @pytest.mark.parametrize("what", ["singular", "indefinite", "nan", "inf"])
    def test_one_without_an_inverse_disturbs_no_other(self, what):
        matrix = self.matrix()
        broken = matrix.clone()
        if what == "singular":
            broken[1, 0] = broken[1, :, 0] = 0
        elif what == "indefinite":
            broken[1] = -broken[1]
        else:
            broken[1, 2, 2] = float(what)
        found, failed = inverse(broken)
        assert failed.tolist() == [False, True]
        torch.testing.assert_close(found[0], inverse(matrix)[0][0], rtol=0, atol=0)

    def test_held_out(self):
        matrix = self.matrix()
        free = torch.tensor([[True] * 5 + [False], [False, True, True, False, True, True]])
        found = inverse(held_out(matrix, free))[0]
        for c in range(2):
            own = free[c].nonzero()[:, 0]
            part = torch.linalg.inv(matrix[c][own][:, own])
            torch.testing.assert_close(found[c][own][:, own], part, rtol=1e-6, atol=0)


def test_a_step_that_leads_back_is_told_by_the_metric():
    """Per camera: back, onwards, the first of all, and aside where it counts most."""
    metric = torch.diag_embed(torch.tensor([1.0, 100.0, 1e-4], dtype=torch.float64)).expand(4, 3, 3)
    last = torch.tensor([[1, 0, 5], [1, 0, 0], [0, 0, 0], [1, 1, 0]], dtype=torch.float64)
    step = torch.tensor([[-0.9, 0, 5], [0.9, 0, 0], [1, 1, 1], [-1, 1, 0]], dtype=torch.float64)
    assert _returns(metric, last, step).tolist() == [True, False, False, False]
