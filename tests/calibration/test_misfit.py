"""What the powers leave out: seen where there is something, and large enough to cover it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import torchptz as tp
from tests import head_body
from tests.calibration.conftest import PRIORS

FIVE = (1.0, 2.0, 3.0, 4.0, 5.0)
CUBIC = (0.01, 0.05, 0.012, 0.0, 0.0)
# Lenses that three powers cannot follow, at the wide end.
STRANGE = {"corners": (0.0, 0.0, 0.0, 0.0, 0.1), "wave": (0.0, 0.0, 0.0, 0.3, -0.2)}
GRID = torch.cartesian_prod(
    torch.linspace(0, head_body.SIZE[0] - 1, 9, dtype=torch.float64),
    torch.linspace(0, head_body.SIZE[1] - 1, 7, dtype=torch.float64),
)


def there(calibration):
    """(C, Z) bool, zooms whose lens has a misfit."""
    size = 2 + len(calibration.powers)
    return calibration.misfit.diagonal(dim1=2, dim2=3)[..., :size].any(2)


def made_of(barrel, **changed):
    return head_body.body(1, zooms=(1.0, 5.0), powers=FIVE, barrel=barrel, **changed)


def observed(barrel, draws):
    made = made_of(barrel)
    return made, head_body.observed(made, draws=draws)


def shape_errors(calibration, made):
    """(C, Z) errors of undistorted points over what is stated, similarities of the picture left
    out: root mean squares over a grid."""
    lens, zooms = calibration.lens, len(made.zooms)
    points = GRID.expand(len(lens), -1, -1)
    found = lens.undistort(points)
    truth = [made.undistort(GRID.numpy(), np.full(len(GRID), z)) for z in range(zooms)]
    away = found - torch.from_numpy(np.stack(truth)).repeat(len(calibration), 1, 1)

    def undistorted(parameters):
        own = replace(lens, center=parameters[:, :2], coefficients=parameters[:, 2:])
        return own.undistort(points).sum(0)

    parameters = torch.cat([lens.center, lens.coefficients], 1)
    columns = torch.func.jacrev(undistorted)(parameters).permute(2, 0, 1, 3).flatten(1, 2)
    x, y = (found - lens.center[:, None]).unbind(-1)
    one, nothing = torch.ones_like(x), torch.zeros_like(x)
    alike = torch.stack(
        [torch.stack([one, nothing, x, -y], -1), torch.stack([nothing, one, y, x], -1)], -2
    )
    basis = torch.linalg.qr(alike.flatten(1, 2)).Q

    def projected(values):
        return values - basis @ (basis.mT @ values)

    shape = projected(columns)
    stated = ((shape @ calibration.lens_covariance) * shape).sum((1, 2))
    square = projected(away.flatten(1).unsqueeze(-1)).square().sum((1, 2))
    return (square / stated).sqrt().reshape(len(calibration), zooms)


class TestNone:
    def test_where_the_powers_follow_the_lens(self):
        made, seen = observed(CUBIC, 10)
        calibration = tp.calibrate(seen, PRIORS)
        assert there(calibration).double().mean() <= 0.1
        assert shape_errors(calibration, made).median() < 1.6

    def test_nor_where_they_are_more_than_enough(self):
        _, seen = observed(CUBIC, 3)
        calibration = tp.calibrate(seen, PRIORS, powers=FIVE)
        assert there(calibration).sum() <= 1


@pytest.fixture(scope="module", params=STRANGE.values(), ids=STRANGE)
def case(request):
    made, seen = observed(request.param, 5)
    return made, seen, tp.calibrate(seen, PRIORS)


class TestSome:
    def test_is_seen(self, case):
        _, _, calibration = case
        assert bool(there(calibration).all())

    def test_covers_the_error_of_the_picture(self, case):
        """Which without it was many times what is stated."""
        made, _, calibration = case
        covered = shape_errors(calibration, made)
        bare = shape_errors(replace(calibration, misfit=0 * calibration.misfit), made)
        assert bare.median(0).values.min() > 3
        assert covered.median(0).values.max() < 2
        assert covered.median(0).values.min() > 0.5

    def test_is_a_covariance(self, case):
        misfit = case[2].misfit.flatten(0, 1)
        torch.testing.assert_close(misfit, misfit.mT)
        size = misfit.diagonal(dim1=1, dim2=2).sqrt().clamp_min(1e-100)
        assert torch.linalg.eigvalsh(misfit / (size[:, :, None] * size[:, None])).min() > -1e-9

    def test_covers_the_error_of_the_focal_length(self, case):
        """With L(0) = 1 a wrong shape is a wrong focal length, too."""
        made, _, calibration = case
        off = (calibration.focal_length - torch.from_numpy(made.focal)).abs()
        assert ((off / calibration.focal_length_sigma).median(0).values < 2).all()

    def test_auto_takes_more_powers_then(self, case):
        made, seen, _ = case
        auto = tp.calibrate(seen, PRIORS, powers="auto")
        assert auto.powers.tolist() == list(FIVE)
        assert there(auto).sum() <= 1
        assert shape_errors(auto, made).median(0).values.max() < 1.6
        off = (auto.focal_length - torch.from_numpy(made.focal)) / auto.focal_length_sigma
        assert off.abs().max() < 4


class TestAuto:
    def test_leaves_zooms_alone_that_need_no_more(self):
        _, seen = observed(CUBIC, 3)
        auto, plain = tp.calibrate(seen, PRIORS, powers="auto"), tp.calibrate(seen, PRIORS)
        assert auto.coefficients[..., 3:].abs().max() == 0
        off = (auto.focal_length - plain.focal_length) / plain.focal_length_sigma
        assert off.abs().max() < 1e-2
        torch.testing.assert_close(
            auto.focal_length_sigma, plain.focal_length_sigma, rtol=1e-2, atol=0
        )

    @pytest.mark.parametrize("powers", ["all", "", (0, 1), (2, 1), ()])
    def test_others_are_refused(self, powers):
        _, seen = observed(CUBIC, 1)
        with pytest.raises(ValueError, match="powers"):
            tp.calibrate(seen, PRIORS, powers=powers)
