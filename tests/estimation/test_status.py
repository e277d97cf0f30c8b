"""Every status is reached by a pattern that deserves it."""

import numpy as np
import pytest
import torch

from tests import synthetic
from torchptz.estimation import Status, estimate
from torchptz.estimation.status import center_sigma, center_unobservable, corner_sigma
from torchptz.patterns import LinePatterns


def barrel(points=12, sigma=0.1, **how):
    return synthetic.noisy(synthetic.pattern_of(synthetic.lens(), points=points, **how), sigma)


def radial():
    """Lines through the centre only, of a lens with distortion."""
    lens = synthetic.lens(center=(319.5, 239.5))
    place = np.linspace(-200, 200, 11)[:, None]
    turns = np.pi * np.arange(9) / 9
    lines = [[319.5, 239.5] + place * [np.cos(turn), np.sin(turn)] for turn in turns]
    lines = [synthetic.truth_of(lens).distort(line) for line in lines]
    return synthetic.noisy(synthetic.stacked(lines), 0.1)


def undistorted():
    lens = synthetic.lens((0.0, 0.0, 0.0))
    return synthetic.noisy(synthetic.pattern_of(lens, points=12), 0.1)


def folding():
    """Lines near the centre, bent so much that the lens that straightens them folds outside."""
    lens = synthetic.lens((0.0, -0.6, 0.0), center=(319.5, 239.5), size=synthetic.PAPER_SIZE)
    lines = []
    for i in range(14):
        normal = np.array([np.cos(2 * np.pi * i / 14), np.sin(2 * np.pi * i / 14)])
        place = np.linspace(-80, 80, 15)[:, None]
        ideal = [319.5, 239.5] + (20 + 6 * i) * normal + place * [-normal[1], normal[0]]
        lines.append(synthetic.truth_of(lens).distort(ideal))
    return synthetic.noisy(synthetic.stacked(lines), 0.02)


CASES = {
    Status.OK: (barrel, {}),
    Status.TOO_FEW_LINES: (lambda: barrel(lines=2, points=30), {}),
    Status.CENTER_UNOBSERVABLE: (undistorted, {}),
    Status.DISTORTION_UNOBSERVABLE: (radial, {}),
    Status.NOT_MONOTONIC: (folding, {"powers": (2,)}),
    Status.NOT_CONVERGED: (lambda: barrel(points=35), {"max_iterations": 2}),
}


@pytest.mark.parametrize("status", CASES, ids=lambda status: status.name)
def test_a_pattern_gets_the_status_it_deserves(status):
    make, options = CASES[status]
    assert estimate(make(), **options).status == [status]


def test_no_status_is_without_a_case():
    assert set(CASES) == set(Status)


def test_too_few_points_for_the_unknowns():
    # 5 lines of 3 points: one degree of freedom a line for five unknowns.
    assert estimate(barrel(lines=5, points=3), max_iterations=20).status == [Status.TOO_FEW_LINES]
    # An offset's gain is an unknown more.
    pattern = barrel(lines=6, points=3)
    with_gain = LinePatterns(
        pattern.points, pattern.mask, pattern.image_size, offsets=torch.randn_like(pattern.points)
    )
    assert estimate(pattern, max_iterations=20).status != [Status.TOO_FEW_LINES]
    assert estimate(with_gain, max_iterations=20).status == [Status.TOO_FEW_LINES]


def test_items_of_a_batch_get_their_own():
    cases = [make() for status, (make, options) in CASES.items() if not options]
    expected = [status for status, (_, options) in CASES.items() if not options]
    assert estimate(LinePatterns.stack(cases), max_iterations=60).status == expected


def test_lines_through_the_centre_free_of_noise_are_seen_through_too():
    place = np.linspace(-200, 200, 11)[:, None]
    turns = np.pi * np.arange(9) / 9
    lines = [[319.5, 239.5] + place * [np.cos(turn), np.sin(turn)] for turn in turns]
    assert estimate(synthetic.stacked(lines)).status == [Status.DISTORTION_UNOBSERVABLE]


def test_a_centre_that_cannot_be_told_is_kept():
    start = torch.tensor([[301.0, 222.0]], dtype=torch.float64)
    fit = estimate(undistorted(), center=start)
    assert fit.status == [Status.CENTER_UNOBSERVABLE]
    assert torch.equal(fit.lens.center, start)
    assert fit.covariance[0, :2, :2].diagonal().isinf().all()
    none = synthetic.truth_of(synthetic.lens((0.0, 0.0, 0.0)))
    assert synthetic.largest_error(fit.lens, none, similarity=True) < 1.5


@pytest.mark.parametrize("sigma", [0.0, 0.1, 0.2])
def test_no_noise_is_taken_for_a_centre(sigma):
    lens = synthetic.lens((0.0, 0.0, 0.0))
    fit = estimate(synthetic.noisy(synthetic.pattern_of(lens, points=12), sigma, draws=6))
    assert fit.status == [Status.CENTER_UNOBSERVABLE] * 6
    assert (fit.lens.center == synthetic.double(319.5, 239.5)).all()


def test_a_weak_lens_has_a_centre():
    # 1.3 px at the left and right border, 0.1 px of noise.
    lens = synthetic.lens((0.0, 0.004, 0.0))
    fit = estimate(synthetic.noisy(synthetic.pattern_of(lens, points=35), 0.1, draws=4))
    assert fit.status == [Status.OK] * 4


def test_the_good_one_ends_in_ok_and_the_others_say_what_to_do():
    assert str(Status.OK).endswith("OK")
    for status in set(Status) - {Status.OK}:
        assert not str(status).endswith("OK")
        assert len(status.value) > 20


class TestSigmas:
    def test_of_the_centre_in_its_least_known_direction(self):
        covariance = torch.eye(5, dtype=torch.float64)[None].repeat(3, 1, 1)
        covariance[0, :2, :2] = torch.tensor([[5.0, 4.0], [4.0, 5.0]])
        covariance[1, 1, 1] = torch.inf
        torch.testing.assert_close(
            center_sigma(covariance), synthetic.double(3.0, float("inf"), 1.0)
        )

    def test_coefficients_within_their_noise_show_no_centre(self):
        covariance = 1e-4 * torch.eye(5, dtype=torch.float64)[None].repeat(3, 1, 1)
        covariance[2, 3, 3] = torch.inf
        coefficients = 0.01 * torch.tensor([[1.0, -2, 1], [5, -7, 1], [50, 70, 10]]).double()
        got = center_unobservable(coefficients, covariance, torch.full((3,), 320.0))
        assert got.tolist() == [True, False, True]

    def test_of_the_farthest_corner(self):
        lens = synthetic.lens(center=(319.5, 239.5))
        covariance = torch.zeros(2, 5, 5, dtype=torch.float64)
        covariance[0, 3, 3] = 0.01**2
        covariance[1, 4, 4] = torch.inf
        # What the best scale over the disc, by brute force, leaves of 0.01 r³ at its rim.
        rim = np.hypot(320, 240) / 320
        r = np.linspace(0, rim, 100_001)
        scale = (r * r**3 * r).sum() / (r * r * r).sum()
        left = 320 * 0.01 * (rim**3 - scale * rim)
        np.testing.assert_allclose(corner_sigma(lens[0], covariance[:1]), [left], rtol=1e-4)
        assert corner_sigma(lens[0], covariance[1:]).isinf().all()
