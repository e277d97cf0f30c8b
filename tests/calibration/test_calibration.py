"""What a calibration says: its values, their covariance, and what is missing."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import torchptz as tp
from tests import head_body
from tests.calibration.conftest import PRIORS
from torchptz.calibration.parameters import HEAD


def intrinsics(theta, layout, zoom):
    """(cx, cy, l..., f, ppx, ppy) of a zoom as a function of the unknowns (T,), by hand."""
    own = theta[zoom * layout.per_zoom : (zoom + 1) * layout.per_zoom]
    point = theta[layout.zooms * layout.per_zoom :][:2] + own[1:3]
    return torch.cat([point + own[3:5], own[5:-1], own[:1].exp(), point])


class TestValues:
    def test_are_those_of_theta(self, fleet, calibrated):
        for c, made in enumerate(fleet[0]):
            zooms, features = len(made.zooms), len(made.ray)
            layout = calibrated.layout
            parts = [part[c].numpy() for part in layout.split(calibrated.theta)]
            parts = [parts[0][:zooms].ravel(), parts[1], parts[2][:features].ravel()]
            found = head_body.body_of(np.concatenate(parts), made)
            own = {
                "focal": calibrated.focal_length[c, :zooms],
                "point": calibrated.principal_point[c, :zooms],
                "center": calibrated.center[c, :zooms],
                "coefficients": calibrated.coefficients[c, :zooms],
                "pupil": calibrated.pupil_m[c, :zooms],
                "tilt_zero": calibrated.tilt_zero[c],
                "boresight": calibrated.boresight[c],
                "roll": calibrated.roll[c],
                "scale": calibrated.axis_scale[c],
                "aspect": calibrated.pixel_aspect[c],
                "backlash": calibrated.backlash[c],
                "distance": calibrated.distance_m[c, :features],
            }
            for name, value in own.items():
                np.testing.assert_allclose(value, getattr(found, name), rtol=1e-12, err_msg=name)
            pan, tilt = found.ray.T
            ray = [-np.sin(pan) * np.cos(tilt), np.sin(tilt), np.cos(pan) * np.cos(tilt)]
            np.testing.assert_allclose(calibrated.ray[c, :features], np.stack(ray, -1), atol=1e-15)

    def test_are_near_the_truth(self, fleet, calibrated):
        for c, made in enumerate(fleet[0]):
            zooms = len(made.zooms)
            off = calibrated.focal_length[c, :zooms] - torch.from_numpy(made.focal)
            assert (off.abs() < 5 * calibrated.focal_length_sigma[c, :zooms]).all()
            for name in ("tilt_zero", "boresight", "roll"):
                sigma = calibrated.head_sigma[name.replace("_", " ")][c]
                assert abs(getattr(calibrated, name)[c] - getattr(made, name)) < 5 * sigma

    def test_what_a_camera_does_not_have_is_nan(self, calibrated):
        assert calibrated.exists.tolist() == [[True] * 3, [True, True, False], [True, False, False]]
        missing = ~calibrated.exists
        for name in (
            *("focal_length", "focal_length_sigma", "principal_point", "center", "coefficients"),
            *("pupil_m", "pupil_sigma_m", "rms_px", "zooms"),
        ):
            value = getattr(calibrated, name)
            assert bool(value[missing].isnan().all()), name
            assert bool(value[~missing].isfinite().all()), name

    def test_everything_else_is_a_number(self, calibrated):
        for name in (
            *("theta", "covariance", "reading_sigma", "noise_factor", "residuals", "distances"),
            *("intrinsics_covariance", "lens_covariance"),
        ):
            assert bool(getattr(calibrated, name).isfinite().all()), name


class TestLens:
    def test_is_one_of_every_camera_and_zoom_that_exist(self, calibrated):
        assert calibrated.pairs.tolist() == [[0, 0], [0, 1], [0, 2], [1, 0], [1, 1], [2, 0]]
        lens = calibrated.lens
        camera, zoom = calibrated.pairs.unbind(1)
        assert len(lens) == 6
        torch.testing.assert_close(lens.center, calibrated.center[camera, zoom])
        torch.testing.assert_close(lens.coefficients, calibrated.coefficients[camera, zoom])
        assert lens.powers.tolist() == [1, 2, 3]
        assert lens.scale.tolist() == [head_body.SIZE[0] / 2] * 6

    def test_knows_its_pixel_aspect(self):
        made = head_body.body(0, zooms=(1.0,), aspect=1.1)
        seen = head_body.observed(made, head_body.plan(made, grid=(5, 4), tracks=2))
        lens = tp.calibrate(seen, replace(PRIORS, pixel_aspect=1.1)).lens
        assert lens.pixel_aspect.tolist() == [pytest.approx(1.1)]


class TestCovariance:
    def test_of_the_intrinsics_is_that_of_theta_carried_over(self, calibrated):
        layout = calibrated.layout
        torch.manual_seed(0)
        rows = torch.randn(*calibrated.misfit.shape[:3], 9, dtype=torch.float64)
        size = torch.tensor([0.1, 0.1, *[1e-3] * 4, 0.1, 0.1], dtype=torch.float64)
        misfit = rows @ rows.mT * size[:, None] * size
        calibrated = replace(calibrated, misfit=misfit)
        for item, (camera, zoom) in enumerate(calibrated.pairs.tolist()):
            theta = calibrated.theta[camera]
            jacobian = torch.func.jacrev(intrinsics)(theta, layout, zoom)
            expected = jacobian @ calibrated.covariance[camera] @ jacobian.T
            unit = torch.ones(8, dtype=torch.float64)  # the misfit is that of log f
            unit[5] = calibrated.focal_length[camera, zoom]
            expected += calibrated.misfit[camera, zoom] * unit[:, None] * unit
            size = expected.diagonal().sqrt()
            off = (calibrated.intrinsics_covariance[item] - expected) / (size[:, None] * size)
            assert off.abs().max() < 1e-9

    def test_that_of_the_lens_is_its_corner(self, calibrated):
        torch.testing.assert_close(
            calibrated.lens_covariance, calibrated.intrinsics_covariance[:, :5, :5], rtol=0, atol=0
        )

    def test_is_symmetric_and_positive(self, calibrated):
        for covariance in (calibrated.covariance, calibrated.intrinsics_covariance):
            torch.testing.assert_close(covariance, covariance.mT)
            size = covariance.diagonal(dim1=1, dim2=2).sqrt().clamp_min(1e-100)
            scaled = covariance / (size[:, :, None] * size[:, None])
            assert torch.linalg.eigvalsh(scaled).min() > -1e-9

    def test_sigmas_are_its_diagonal(self, calibrated):
        camera, zoom = calibrated.pairs.unbind(1)
        variance = calibrated.intrinsics_covariance.diagonal(dim1=1, dim2=2)
        torch.testing.assert_close(
            calibrated.focal_length_sigma[camera, zoom], variance[:, 5].sqrt(), rtol=1e-9, atol=0
        )
        layout = calibrated.layout
        zooms, head, _ = layout.split(calibrated.covariance.diagonal(dim1=1, dim2=2).sqrt())
        torch.testing.assert_close(
            calibrated.pupil_sigma_m[camera, zoom], zooms[camera, zoom, layout.pupil]
        )
        assert tuple(calibrated.head_sigma) == HEAD
        torch.testing.assert_close(torch.stack(list(calibrated.head_sigma.values()), 1), head)

    def test_has_nothing_of_what_is_held(self, calibrated):
        held = ~calibrated.known.free
        assert bool(held.any())
        assert calibrated.covariance[held].abs().max() == 0


class TestResiduals:
    def test_are_seen_less_predicted_at_the_poses_as_read(self, fleet, calibrated):
        made, looks = fleet[0][2], fleet[1][2]
        layout = calibrated.layout
        parts = [part[2].numpy() for part in layout.split(calibrated.theta)]
        theta = np.concatenate([parts[0][0], parts[1], parts[2][0]])
        found = head_body.body_of(theta, made)
        load = head_body.behind(looks["read"], np.array(found.backlash))
        zoom = np.zeros(len(load), int)
        expected = looks["pixel"] - found.see(load, zoom, looks["feature"])
        seen = np.isfinite(looks["pixel"]).all(1)
        residuals = calibrated.residuals[2, : len(load)]
        np.testing.assert_allclose(residuals[seen], expected[seen], atol=1e-7)
        assert residuals[~seen].abs().max() == 0 if (~seen).any() else True

    def test_rms_is_that_of_the_inliers(self, calibrated, fleet):
        seen = tp.Observations.from_lists(fleet[1])
        for camera, zoom in calibrated.pairs.tolist():
            own = calibrated.inliers[camera] & (seen.zoom[camera] == zoom)
            expected = calibrated.residuals[camera, own].square().mean().sqrt()
            torch.testing.assert_close(calibrated.rms_px[camera, zoom], expected)

    def test_distances_are_of_order_one(self, calibrated):
        """Of two coordinates with the head's noise: their squares are 2 in the mean."""
        for c in range(3):
            square = calibrated.distances[c, calibrated.inliers[c]].square().mean()
            assert 1.2 < square < 2.8

    def test_what_was_not_found_is_no_inlier(self, calibrated, fleet):
        found = tp.Observations.from_lists(fleet[1]).found
        assert not bool((calibrated.inliers & ~found).any())
        assert calibrated.inliers.sum() == found.sum()


class TestBatch:
    @pytest.mark.parametrize("index", [0, 1, 2, -1])
    def test_items(self, calibrated, index):
        one = calibrated[index]
        assert len(one) == 1
        index %= 3
        own = calibrated.pairs[:, 0] == index
        torch.testing.assert_close(one.lens.center, calibrated.lens.center[own], rtol=0, atol=0)
        torch.testing.assert_close(
            one.intrinsics_covariance, calibrated.intrinsics_covariance[own], rtol=0, atol=0
        )
        assert one.camera == [calibrated.camera[index]] == [f"body {index} 0"]
        assert one.status == [calibrated.status[index]]

    def test_slices(self, calibrated):
        part = calibrated[1:]
        assert part.camera == calibrated.camera[1:]
        torch.testing.assert_close(part.focal_length, calibrated.focal_length[1:], equal_nan=True)


class TestUndetermined:
    """Camera by camera what stayed at its prior, in words."""

    def names(self, calibration):
        return [{one.name for one in camera} for camera in calibration.undetermined]

    def test_what_nobody_can_know_is_always_said(self, calibrated):
        for names in self.names(calibrated):
            assert "pan zero" in names
            assert "tilt zero and the optical axis' turn about the tilt axis" in names

    def test_a_pupil_that_one_feature_cannot_tell(self, calibrated):
        """The second camera's two features are equally far: no more than one."""
        for c, one in enumerate(calibrated.undetermined):
            pupil = next(entry for entry in one if entry.name == "entrance pupil")
            assert pupil.zooms == tuple(calibrated.zooms[c, calibrated.exists[c]].tolist())
            assert pupil.sigma == pytest.approx(0.001, rel=0.3)
            assert pupil.unit == "m"
            assert "distance" in pupil.advice

    def test_what_the_data_tell_is_not_said(self, calibrated):
        for names in self.names(calibrated)[:2]:
            assert not names & {"tilt zero", "boresight", "roll", "focal length"}

    def test_a_head_that_cannot_tell_its_own_zero(self):
        """A narrow scan says nothing about a tilt zero that is known to 0.001 degrees."""
        made = head_body.body(0, zooms=(25.0,))
        seen = head_body.observed(made, head_body.plan(made, grid=(5, 4), tracks=2))
        tight = replace(
            PRIORS, tilt_zero_sigma=math.radians(1e-3), boresight_sigma=math.radians(1e-3)
        )
        calibration = tp.calibrate(seen, tight)
        found = {one.name: one for one in calibration.undetermined[0]}
        assert found["tilt zero"].sigma == pytest.approx(1e-3, rel=0.3)
        assert found["tilt zero"].unit == "degrees"
        assert "boresight" in found

    def test_reads_as_a_sentence(self, calibrated):
        for one in calibrated.undetermined[0]:
            assert one.advice in str(one)
            assert str(one).startswith(one.name)
            assert all(f"{zoom:g}x" in str(one) for zoom in one.zooms)
