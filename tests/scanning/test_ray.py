"""Ray and focal length from readings at the longest zoom."""

import numpy as np
import pytest
import torch

from tests.synthetic import RZ30_QUANTUM, double
from torchptz.geometry import project, ray_from_pan_tilt, to_camera
from torchptz.scanning.ray import estimate_ray

FOCAL, POINT = 18450.0, double(371.0, 268.5)
PAN, TILT = 0.31, 0.22
RAY = ray_from_pan_tilt(*double(PAN, TILT))


def readings(steps=3, apart=4):
    """A square of poses on the head's grid around the feature, (N,) each."""
    k = torch.arange(-steps, steps + 1, dtype=torch.float64) * apart
    pan, tilt = torch.cartesian_prod(k * RZ30_QUANTUM[0], k * RZ30_QUANTUM[1]).unbind(-1)
    return PAN + pan, TILT + tilt


def seen(pan, tilt, focal_length=FOCAL, aspect=1.0):
    return POINT + focal_length * double(1.0, aspect) * project(to_camera(RAY, pan, tilt))


def angle_to_truth(found):
    return float(torch.linalg.vector_norm(torch.linalg.cross(found.ray, RAY)))


@pytest.mark.parametrize("start", [0.8, 1.0, 1.3])
@pytest.mark.parametrize("aspect", [1.0, 0.87])
def test_exact_readings_give_both_exactly(start, aspect):
    pan, tilt = readings()
    found = estimate_ray(
        pan, tilt, seen(pan, tilt, aspect=aspect), POINT, start * FOCAL, pixel_aspect=aspect
    )
    assert angle_to_truth(found) < 1e-12
    assert found.focal_length == pytest.approx(FOCAL, rel=1e-9)
    assert found.rms_px < 1e-6
    assert float(found.ray.norm()) == pytest.approx(1.0)


def test_displacement_from_the_principal_point_is_corrected():
    # All poses to one side: their mean reading is far from the ray.
    pan, tilt = readings()
    pan, tilt = pan + 0.004, tilt - 0.003
    found = estimate_ray(pan, tilt, seen(pan, tilt), POINT, FOCAL)
    assert angle_to_truth(found) < 1e-12
    mean = ray_from_pan_tilt(pan.mean(), tilt.mean())
    assert float(torch.linalg.vector_norm(torch.linalg.cross(mean, RAY))) > 4e-3


def test_what_was_known_of_the_focal_length_counts_by_its_sigma():
    pan, tilt = readings()
    exact = seen(pan, tilt)
    known = 1.05 * FOCAL
    # Exact readings know better than anything said beforehand.
    assert estimate_ray(pan, tilt, exact, POINT, known, 0.01 * known).focal_length == pytest.approx(
        FOCAL, rel=1e-6
    )
    generator = torch.Generator().manual_seed(3)
    noisy = exact + 30 * torch.randn(exact.shape, generator=generator, dtype=torch.float64)
    alone = estimate_ray(pan, tilt, noisy, POINT, known)
    sigma = alone.focal_length_sigma
    together = estimate_ray(pan, tilt, noisy, POINT, known, sigma)
    # Two values known equally well: their mean, sqrt(2) better than either.
    assert together.focal_length == pytest.approx((alone.focal_length + known) / 2)
    assert together.focal_length_sigma == pytest.approx(sigma / 2**0.5)


def test_the_error_of_the_principal_point_moves_the_ray_by_as_much_over_f():
    pan, tilt = readings()
    found = estimate_ray(
        pan, tilt, seen(pan, tilt), POINT + double(5.0, 0.0), FOCAL, principal_point_sigma=5.0
    )
    assert angle_to_truth(found) == pytest.approx(5.0 / FOCAL, rel=1e-3)
    assert found.ray_sigma == pytest.approx(5.0 / FOCAL, rel=1e-3)
    assert found.focal_length == pytest.approx(FOCAL, rel=1e-5)


def test_sigmas_are_honest():
    pan, tilt = readings(steps=2)
    exact = seen(pan, tilt)
    generator = torch.Generator().manual_seed(0)
    found = []
    for _ in range(60):
        noise = 0.5 * torch.randn(exact.shape, generator=generator, dtype=torch.float64)
        found.append(estimate_ray(pan, tilt, exact + noise, POINT, FOCAL))
    focal = np.array([one.focal_length for one in found])
    assert abs(focal.mean() - FOCAL) < 4 * focal.std() / 60**0.5
    predicted = np.mean([one.focal_length_sigma for one in found])
    assert predicted == pytest.approx(focal.std(), rel=0.3)
    off = np.array([angle_to_truth(one) for one in found])
    # Two axes of the same sigma each.
    assert np.sqrt((off**2).mean() / 2) == pytest.approx(
        np.mean([one.ray_sigma for one in found]), rel=0.3
    )
    assert np.mean([one.rms_px**2 for one in found]) == pytest.approx(0.25, rel=0.1)


def test_reading_jitter_is_averaged():
    pan, tilt = readings(steps=2)
    generator = torch.Generator().manual_seed(1)
    off, sigma = [], []
    for _ in range(25):
        slip = (torch.rand(2, len(pan), generator=generator).double() - 0.5) * double(
            *RZ30_QUANTUM
        )[:, None]
        found = estimate_ray(pan, tilt, seen(pan + slip[0], tilt + slip[1]), POINT, FOCAL)
        off.append(angle_to_truth(found))
        sigma.append(found.ray_sigma)
    one_reading = np.hypot(*RZ30_QUANTUM) / 12**0.5
    root = np.sqrt(np.mean(np.square(off)))
    assert root < 1.3 * one_reading / len(pan) ** 0.5
    assert np.mean(sigma) == pytest.approx(root / 2**0.5, rel=0.35)


def test_too_few_poses():
    pan, tilt = readings()
    with pytest.raises(ValueError, match="at least 3 different poses"):
        estimate_ray(pan[:2], tilt[:2], seen(pan[:2], tilt[:2]), POINT, FOCAL)


def test_poses_all_alike():
    pan, tilt = double(PAN, PAN, PAN, PAN), double(TILT, TILT, TILT, TILT)
    with pytest.raises(ValueError, match="at least 3 different poses"):
        estimate_ray(pan, tilt, seen(pan, tilt), POINT, FOCAL)
