"""The benchmark's section on the complete calibration: its peers are right, and it runs."""

from __future__ import annotations

import json

import numpy as np
import pytest

from torchptz.files import without_nan


@pytest.fixture(scope="module")
def section(load):
    return load("estimate.complete")


@pytest.fixture(scope="module")
def peers(load):
    return load("estimate.complete_peers")


@pytest.fixture(scope="module")
def case(section):
    """A camera of a few looks, and where it starts."""
    made = section._case(1, (3, 3), 5)
    return made.cameras[0], made.starts[0]


@pytest.fixture(scope="module")
def solved(peers, case):
    """The camera solved by both."""
    return peers.schur(*case), peers.scipy_sparse(*case)


class TestPeers:
    def test_derivatives(self, load, case):
        """Analytic ones against central differences, everywhere but at the start."""
        camera, start = case
        model = load("estimate.complete_model").Explicit(camera)
        x = model.start(start)
        x = x + 1e-3 * np.random.default_rng(0).normal(size=len(x))
        jacobian = model.jacobian(x).toarray()
        assert jacobian.shape == (2 * model.looks + len(x), len(x))
        for place in [*range(model.own), model.own, model.own + 1, len(x) - 1]:
            step = np.zeros_like(x)
            step[place] = 1e-6 * max(1.0, abs(x[place]))
            moved = (model.residual(x + step) - model.residual(x - step)) / (2 * step[place])
            size = np.abs(jacobian[:, place]).max()
            np.testing.assert_allclose(jacobian[:, place] / size, moved / size, atol=2e-5)

    def test_they_find_the_same_optimum(self, case, solved):
        camera, _ = case
        one, other = solved
        assert one.cost == pytest.approx(other.cost, rel=1e-6)
        free, sigma = camera.prior > 0, np.sqrt(np.diag(one.covariance))
        assert np.abs((one.theta - other.theta)[free] / sigma).max() < 1e-2
        both = np.outer(sigma, sigma)
        np.testing.assert_allclose(other.covariance / both, one.covariance / both, atol=1e-2)

    def test_nothing_is_better_nearby(self, load, case, solved):
        """However the unknowns move by a tenth of their sigmas, if the stops move along."""
        camera, _ = case
        model = load("estimate.complete_model").Explicit(camera)
        one = solved[0]
        free = model.free
        sigma = np.sqrt(np.diag(one.covariance))
        for seed in range(20):
            away = np.random.default_rng(seed).normal(size=free.sum()) * 0.1 * sigma
            moved = one.theta.copy()
            moved[free] += away
            assert self.marginal(model, moved) > self.marginal(model, one.theta)

    @staticmethod
    def marginal(model, theta):
        """Cost with the stops where they are best, by a few Gauss-Newton steps of their own."""
        x = model.start(theta)
        for _ in range(4):
            jacobian = model.jacobian(x)[:, model.own :].toarray()
            residual = model.residual(x)
            x[model.own :] -= np.linalg.solve(jacobian.T @ jacobian, jacobian.T @ residual)
        residual = model.residual(x)
        return residual @ residual

    def test_play_is_refused(self, load, case):
        camera, _ = case
        prior = np.where(camera.prior > 0, camera.prior, 1.0)
        fields = camera.__dict__ | {"prior": prior}
        with pytest.raises(ValueError, match="play"):
            load("estimate.complete_model").Camera(**fields)


@pytest.fixture(scope="module")
def result(section):
    """The section's figures as the file has them."""
    return json.loads(json.dumps(without_nan(section.run(quick=True))))


class TestSection:
    def test_all_agree(self, section, result):
        checks = section.checks(result)
        assert len(checks) == 4
        assert all(checks.values()), checks

    def test_everyone_is_timed(self, section, result):
        contestants = result["race"]["contestants"]
        assert set(contestants) == set(result["agreement"])
        assert all(one["seconds"]["median"] > 0 for one in contestants.values())

    def test_table(self, section, result):
        rows = section.table(result).splitlines()
        assert len(rows) == 4 + len(result["race"]["contestants"])
        assert all(row.count("|") == 8 for row in rows[2:])

    def test_checks_can_fail(self, section, result):
        slow = json.loads(json.dumps(result)) | {"quick": False}
        for one in slow["race"]["contestants"].values():
            one["ratio"] = {"median": 0.5, "low": 0.5, "high": 0.5}
        for one in slow["agreement"].values():
            one["focal_sigmas"] = one["corrected_px"] = 1e3
        checks = section.checks(slow)
        assert len(checks) == 6
        assert not any(checks.values())
