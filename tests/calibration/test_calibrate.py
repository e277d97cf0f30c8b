"""`calibrate` as a whole: against scipy, gauges, independent items, priors, what is handed in."""

import math
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

import torchptz as tp
from tests import head_body
from tests.calibration.conftest import PRIORS
from tests.calibration.test_refinement import ErrorsInVariables
from torchptz.calibration.parameters import TILT_ZERO
from torchptz.observations import Observations

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


def looks(seed=0, grid=(7, 5), **changed):
    """One camera, and where it looked."""
    how = {name: changed.pop(name) for name in ("jitter", "reading", "draws") if name in changed}
    made = head_body.body(seed, **changed)
    return made, head_body.looks(made, head_body.plan(made, grid=grid), seed, **how)


def calibrate(*cameras, **how):
    return tp.calibrate(Observations.from_lists(cameras), how.pop("priors", PRIORS), **how)


def differences(first, c, second, d):
    """Largest relative difference between camera c of one calibration and d of another."""
    zooms = min(first.exists.shape[1], second.exists.shape[1])
    out = {}
    for name in (
        *("focal_length", "focal_length_sigma", "principal_point", "center", "coefficients"),
        *("pupil_m", "pupil_sigma_m", "rms_px"),
    ):
        one, other = getattr(first, name)[c, :zooms], getattr(second, name)[d, :zooms]
        assert bool((one.isnan() == other.isnan()).all()), name
        size = other.abs().nan_to_num(0.0).amax()
        out[name] = ((one - other).abs().nan_to_num(0.0).amax() / size.clamp_min(1e-9)).item()
    for name in ("tilt_zero", "boresight", "roll", "reading_sigma", "noise_factor", "axis_scale"):
        one, other = getattr(first, name)[c], getattr(second, name)[d]
        out[name] = ((one - other).abs() / other.abs().clamp_min(1e-6)).max().item()
    mine = first.intrinsics_covariance[first.pairs[:, 0] == c]
    others = second.intrinsics_covariance[second.pairs[:, 0] == d]
    size = others.diagonal(dim1=1, dim2=2).sqrt()
    size = size[:, :, None] * size[:, None]
    out["covariance"] = ((mine - others).abs() / size).max().item() if len(mine) else 0.0
    out["status"] = float(first.status[c][:zooms] != second.status[d][:zooms])
    return out


class TestAgainstScipy:
    def test_the_same_optimum(self):
        """Of the explicit problem with all poses as unknowns, from a start of its own."""
        made = head_body.body(3, zooms=(1.0, 5.0), tilt_zero=0.01, boresight=-0.01, roll=0.02)
        planned = head_body.plan(made, quantum=(0.0, 0.0), grid=(4, 3), tracks=4)
        one = head_body.looks(made, planned, reading=1e-4)[0]
        priors = replace(PRIORS, repeatability=1e-4, reading_known=True, backlash_sigma=0.0)
        found = calibrate(one, priors=priors, robust=False)
        explicit = ErrorsInVariables(made, one, found.known, (1e-4, 1e-4))
        theta, covariance = explicit.solve(head_body.theta_of(made)[0].numpy())
        off = (found.theta[0].numpy() - theta)[explicit.free]
        assert np.abs(off / np.sqrt(np.diag(covariance))).max() < 0.05
        own = found.covariance[0].diagonal().numpy()[explicit.free]
        np.testing.assert_allclose(own, np.diag(covariance), rtol=5e-3)

    def test_known_noise_is_not_learnt(self):
        _, cameras = looks(jitter=0.3)
        quantum = np.array(head_body.QUANTUM)
        priors = replace(PRIORS, repeatability=1e-3, reading_known=True)
        found = calibrate(*cameras, priors=priors)
        expected = np.sqrt(quantum**2 / 12 + 1e-6)
        np.testing.assert_allclose(found.reading_sigma[0], expected)
        assert found.noise_factor.tolist() == [1]


@pytest.fixture(scope="module")
def before():
    """A camera whose tilt zero nobody knows, and its calibration."""
    _, (one,) = looks(0, jitter=0.3)
    free = replace(PRIORS, tilt_zero_sigma=100.0)
    return one, free, calibrate(one, priors=free)


class TestGauge:
    @pytest.mark.parametrize("shift", [0.7, -3.0, 2 * math.pi, 1e-3])
    def test_another_zero_of_the_pan_turns_the_rays_and_nothing_else(self, before, shift):
        one, free, before = before
        turned = {name: one[name] + (shift, 0) for name in ("read", "commanded")}
        after = calibrate({**one, **turned}, priors=free)
        assert max(differences(after, 0, before, 0).values()) < 1e-7
        rotation = torch.from_numpy(head_body.about_y(-shift))
        torch.testing.assert_close(after.ray, before.ray @ rotation.T, rtol=0, atol=1e-9)

    @pytest.mark.parametrize("shift", [0.1, -0.3, 1e-3])
    def test_another_zero_of_the_tilt_is_its_tilt_zero(self, before, shift):
        """As far as its prior lets it."""
        one, free, before = before
        turned = {name: one[name] + (0, shift) for name in ("read", "commanded")}
        after = calibrate({**one, **turned}, priors=free)
        assert (after.tilt_zero - before.tilt_zero).item() == pytest.approx(-shift, abs=1e-5)
        # A focal length that nothing is known of has a vague prior about where it starts from.
        sigma = before.covariance[0].diagonal().sqrt()
        off = (after.theta - before.theta)[0] / sigma.clamp_min(1e-12)
        tilt_zero = before.layout.zooms * before.layout.per_zoom + TILT_ZERO
        off[tilt_zero] += shift / sigma[tilt_zero]
        assert off.abs().max() < 0.02

    def test_pans_across_the_back(self):
        """Readings that jump by a turn are the same poses."""
        made, (one,) = looks(4, ray=np.array([[math.pi - 0.02, 0.2]]))
        assert np.ptp(one["read"][:, 0]) < 2
        wrapped = {
            name: np.stack([(one[name][:, 0] + np.pi) % (2 * np.pi) - np.pi, one[name][:, 1]], 1)
            for name in ("read", "commanded")
        }
        assert np.ptp(wrapped["read"][:, 0]) > 6
        before, after = calibrate(one), calibrate({**one, **wrapped})
        assert max(differences(after, 0, before, 0).values()) < 1e-6
        off = (after.focal_length[0] - torch.from_numpy(made.focal)) / after.focal_length_sigma[0]
        assert off.abs().max() < 4


@pytest.fixture(scope="module")
def cameras():
    """Different zooms, features, lengths, noise; one with outliers."""
    out = [
        looks(0, jitter=0.3, grid=(5, 4))[1][0],
        looks(1, zooms=(1.0, 4.0), features=2, grid=(4, 3))[1][0],
        looks(2, zooms=(2.0,), jitter=1.0)[1][0],
        looks(3, grid=(4, 3))[1][0],
    ]
    rng = np.random.default_rng(0)
    wrong = rng.random(len(out[0]["zoom"])) < 0.15
    anywhere = rng.uniform(10, 530, (len(wrong), 2))
    out.append({**out[0], "pixel": np.where(wrong[:, None], anywhere, out[0]["pixel"])})
    return out


@pytest.fixture(scope="module")
def together(cameras):
    return calibrate(*cameras)


GARBAGE = (
    *("random pixels", "random readings", "huge readings", "one look", "nothing found"),
    *("one pose", "one pixel", "tiny sigma", "huge sigma", "not a number", "infinite"),
)


@pytest.fixture(scope="module")
def garbage(cameras):
    """One of each kind between two good cameras."""
    one, rng = cameras[3], np.random.default_rng(1)
    count = len(one["zoom"])
    still = np.tile(one["read"][:1], (count, 1))
    first = {name: value[:1] for name, value in one.items() if isinstance(value, np.ndarray)}
    broken = {
        "random pixels": {"pixel": rng.uniform(10, 530, (count, 2))},
        "random readings": {"read": rng.normal(size=(count, 2))},
        "huge readings": {"read": np.full((count, 2), 1e300)},
        "one look": first,
        "nothing found": {"pixel": np.full((count, 2), np.nan)},
        "one pose": {"read": still, "commanded": still},
        "one pixel": {"pixel": np.full((count, 2), 100.0)},
        "tiny sigma": {"sigma": np.full(count, 1e-12)},
        "huge sigma": {"sigma": np.full(count, 1e12)},
    }
    between = [{**one, **broken.get(kind, {})} for kind in GARBAGE]
    seen = Observations.from_lists([cameras[0], *between, cameras[2]])
    # What `from_lists` would not take.
    spoilt = {name: getattr(seen, name).clone() for name in ("read", "pixel", "sigma")}
    for kind, value in (("not a number", math.nan), ("infinite", math.inf)):
        for look, tensor in zip((5, 9, 13), spoilt.values(), strict=True):
            tensor[1 + GARBAGE.index(kind), look] = value
    return tp.calibrate(replace(seen, **spoilt), PRIORS)


class TestIndependence:
    @pytest.mark.parametrize("c", range(5))
    def test_an_item_of_a_batch_is_what_it_is_alone(self, cameras, together, c):
        sliced = tp.calibrate(Observations.from_lists(cameras)[c], PRIORS)
        different = differences(sliced, 0, together, c)
        assert max(different.values()) < 1e-8, different
        different = differences(calibrate(cameras[c]), 0, together, c)
        assert max(different.values()) < 1e-7, different

    def test_their_order_does_not_matter(self, cameras, together):
        order = [4, 2, 0, 3, 1]
        shuffled = calibrate(*(cameras[c] for c in order))
        for place, c in enumerate(order):
            different = differences(shuffled, place, together, c)
            assert max(different.values()) < 1e-9, different

    def test_garbage_harms_nobody_else(self, together, garbage):
        for place, c in ((0, 0), (len(garbage) - 1, 2)):
            different = differences(garbage, place, together, c)
            assert max(different.values()) < 1e-8, different

    @pytest.mark.parametrize("kind", GARBAGE)
    def test_garbage_is_told_from_calibrations(self, together, garbage, kind):
        c = 1 + GARBAGE.index(kind)
        assert bool(garbage.theta[c].isfinite().all())
        assert bool(garbage.covariance[c].isfinite().all())
        own = garbage.intrinsics_covariance[garbage.pairs[:, 0] == c]
        assert bool(own.isfinite().all())
        assert bool((own.diagonal(dim1=1, dim2=2) >= 0).all())
        names = {garbage.status[c][zoom].name for zoom in garbage.exists[c].nonzero()[:, 0]}
        if kind in ("not a number", "infinite"):  # three looks of many
            assert names == {"OK"}
            off = garbage.focal_length[c] - together.focal_length[3]
            assert (off.abs() / together.focal_length_sigma[3]).max() < 1
        elif not kind.endswith("sigma"):
            assert "OK" not in names

    def test_in_parts_it_is_the_same(self, cameras, together, monkeypatch):
        """As many at a time as the memory is good for."""
        monkeypatch.setattr(sys.modules["torchptz.calibration.calibrate"], "_CHUNK", 1)
        parts = calibrate(*cameras)
        for c in range(len(cameras)):
            different = differences(parts, c, together, c)
            assert max(different.values()) < 1e-8, different


@pytest.fixture(scope="module")
def case():
    """A camera with a play under 5 draws of noise."""
    return looks(1, grid=(9, 7), jitter=0.3, draws=5, backlash=(5e-4, 5e-4))


class TestOutliers:
    def good(self, made, found):
        off = (found.focal_length - torch.from_numpy(made.focal)) / found.focal_length_sigma
        assert off.square().mean().sqrt() < 1.6
        assert off.abs().max() < 4.5
        names = [status.name for row in found.status for status in row]
        assert names.count("OK") >= 0.9 * len(names)

    @pytest.mark.parametrize("share", [0.1, 0.2])
    def test_wrong_detections_are_set_aside(self, case, share):
        made, cameras = case
        rng = np.random.default_rng(2)
        wrong = rng.random((len(cameras), len(cameras[0]["zoom"]))) < share
        anywhere = rng.uniform(10, 530, (*wrong.shape, 2))
        found = calibrate(
            *(
                {**one, "pixel": np.where(w[:, None] & ~np.isnan(one["pixel"]), p, one["pixel"])}
                for one, w, p in zip(cameras, wrong, anywhere, strict=True)
            )
        )
        self.good(made, found)
        seen = Observations.from_lists(cameras).found
        wrong = torch.from_numpy(wrong) & seen
        assert (found.inliers & wrong).sum() <= 0.01 * wrong.sum()
        assert (~found.inliers & seen & ~wrong).sum() <= 0.01 * seen.sum()
        quanta = found.reading_sigma / torch.tensor(head_body.QUANTUM) * math.sqrt(12)
        assert (quanta.median(0).values - 0.3).abs().max() < 0.05

    def test_slipped_stops_are_set_aside(self, case):
        """The head stands elsewhere than it says, by degrees, at every twentieth stop."""
        made, cameras = case
        rng = np.random.default_rng(3)
        stop = head_body.stops_of(cameras[0]["commanded"])
        slipped, out = [], []
        for one in cameras:
            which = rng.random(stop[-1] + 1) < 0.05
            by = np.where(which[:, None], rng.choice([-1, 1], (len(which), 2)), 0) * rng.uniform(
                0.02, 0.05, (len(which), 2)
            )
            slipped.append(which[stop])
            out.append({**one, "read": one["read"] + by[stop]})
        found = calibrate(*out)
        self.good(made, found)
        slipped = torch.from_numpy(np.array(slipped)) & Observations.from_lists(cameras).found
        assert slipped.sum() > 30
        assert (found.inliers & slipped).sum() == 0

    def test_not_robust_takes_all_for_true(self, case):
        made, cameras = case
        one = {**cameras[0], "pixel": cameras[0]["pixel"].copy()}
        seen = np.isfinite(one["pixel"]).all(1).nonzero()[0]
        one["pixel"][seen[::15]] = (50.0, 50.0)
        kept = calibrate(one, robust=False)
        assert kept.inliers.sum() == len(seen)
        apart = calibrate(one)
        assert apart.inliers.sum() < len(seen)
        truth = torch.from_numpy(made.focal)
        assert (kept.focal_length / truth - 1).abs().max() > 5 * (
            apart.focal_length / truth - 1
        ).abs().max()

    def test_without_outliers_robust_costs_nothing(self, case):
        _, cameras = case
        first, second = calibrate(cameras[0]), calibrate(cameras[0], robust=False)
        off = (first.focal_length - second.focal_length) / second.focal_length_sigma
        assert off.abs().max() < 1e-2
        ratio = first.focal_length_sigma / second.focal_length_sigma
        assert (ratio - 1).abs().max() < 1e-2


class TestPriors:
    def test_what_data_cannot_tell_stays_at_its_prior(self):
        """One feature says nothing of the pupil but through f, of which nothing is known."""
        _, cameras = looks(1, pupil=np.array([0.02, 0.05, 0.08]))
        priors = replace(PRIORS, pupil_m=0.03, pupil_sigma_m=0.04)
        found = calibrate(*cameras, priors=priors)
        torch.testing.assert_close(
            found.pupil_m, torch.full((1, 3), 0.03).double(), atol=2e-3, rtol=0
        )
        torch.testing.assert_close(
            found.pupil_sigma_m, torch.full((1, 3), 0.04).double(), rtol=0.02, atol=0
        )
        # Over the distance that is the error of the focal length.
        relative = found.focal_length_sigma / found.focal_length
        assert (relative > 0.04 / 12 * 0.98).all()
        assert (relative < 0.04 / 12 * 1.3).all()

    def test_two_features_at_different_distances_tell_the_pupil(self):
        ray, distance = np.array([[0.3, 0.1], [-0.6, 0.5]]), np.array([2.0, 20.0])
        pupil = np.array([0.02, 0.05, 0.08])
        _, cameras = looks(1, features=2, ray=ray, distance=distance, pupil=pupil, draws=5)
        priors = tp.Priors(distance_m=torch.from_numpy(distance)[None], distance_sigma_m=0.005)
        found = calibrate(*cameras, priors=priors)
        assert (found.pupil_sigma_m < 0.002).all()
        off = (found.pupil_m - torch.from_numpy(pupil)) / found.pupil_sigma_m
        assert off.square().mean().sqrt() < 1.6
        names = {one.name for one in found.undetermined[0]}
        assert "entrance pupil" not in names

    @pytest.mark.parametrize(
        ("changed", "name", "value"),
        [
            ({"roll_sigma": 0.0}, "roll", 0.0),
            ({"tilt_zero_sigma": 0.0}, "tilt_zero", 0.0),
            ({"boresight_sigma": 0.0}, "boresight", 0.0),
            ({"backlash_sigma": 0.0}, "backlash", 0.0),
            ({"pupil_sigma_m": 0.0, "pupil_m": 0.07}, "pupil_m", 0.07),
            ({"distance_sigma_m": 0.0, "distance_m": 9.0}, "distance_m", 9.0),
            ({"coefficient_sigma": 0.0}, "coefficients", 0.0),
            ({"axis_scale_sigma": 0.0}, "axis_scale", 1.0),
            ({"pixel_aspect_sigma": 0.0, "pixel_aspect": 1.01}, "pixel_aspect", 1.01),
            ({"focal_length": 700.0, "focal_length_sigma": 0.0}, "focal_length", 700.0),
        ],
        ids=lambda value: value if isinstance(value, str) else "",
    )
    def test_a_sigma_of_zero_holds(self, changed, name, value):
        _, cameras = looks(1, zooms=(1.0,), grid=(5, 4))
        found = getattr(calibrate(*cameras, priors=replace(PRIORS, **changed)), name)
        torch.testing.assert_close(found, torch.full_like(found, value), rtol=1e-14, atol=0)

    def test_the_principal_point_is_held(self):
        _, cameras = looks(1, zooms=(1.0, 5.0), grid=(5, 4))
        point = torch.tensor([370.0, 280.0])
        priors = replace(PRIORS, principal_point=point, principal_point_sigma=0.0, wander_sigma=0.0)
        found = calibrate(*cameras, priors=priors).principal_point
        torch.testing.assert_close(found, point.double().expand_as(found), rtol=0, atol=0)

    def test_the_centre_is_the_principal_point_on_request(self):
        """Which is then known much better: the lens tells it."""
        made = head_body.body(1)
        made = replace(made, center=made.point)
        seen = head_body.observed(made, draws=4)
        found = tp.calibrate(seen, replace(PRIORS, decentering_sigma=0.0))
        torch.testing.assert_close(found.center, found.principal_point, rtol=0, atol=0)
        sigma = found.intrinsics_covariance.diagonal(dim1=1, dim2=2).sqrt()[:, -2:]
        off = (found.principal_point - torch.from_numpy(made.point)).flatten(0, 1) / sigma
        assert off.square().mean().sqrt() < 1.5
        assert sigma.reshape(4, 3, 2)[:, 0].max() < 0.2

    def test_a_focal_length_that_is_known(self):
        """With a prior from elsewhere that is better than the data."""
        made, cameras = looks(1, zooms=(25.0,), jitter=1.0)
        loose = calibrate(*cameras)
        tight = replace(PRIORS, focal_length=made.focal[0] * 1.001, focal_length_sigma=1e-3)
        found = calibrate(*cameras, priors=tight)
        assert (loose.focal_length_sigma / loose.focal_length > 0.01).all()
        assert found.focal_length.item() == pytest.approx(made.focal[0], rel=2e-3)
        relative = (found.focal_length_sigma / found.focal_length).item()
        assert relative == pytest.approx(1e-3, rel=0.05)

    def test_scales_of_the_axes_are_found(self):
        made, cameras = looks(
            1, scale=(1.01, 0.99), features=2, ray=np.array([[1.0, 0.1], [-1.0, 0.8]]), draws=4
        )
        found = calibrate(*cameras, priors=replace(PRIORS, axis_scale_sigma=0.02))
        sigma = torch.stack([found.head_sigma["pan scale"], found.head_sigma["tilt scale"]], -1)
        assert (sigma < 1e-3).all()
        off = (found.axis_scale - torch.tensor(made.scale)) / sigma
        assert off.square().mean().sqrt() < 1.8
        off = (found.focal_length - torch.from_numpy(made.focal)) / found.focal_length_sigma
        assert off.square().mean().sqrt() < 1.8
        assert {status.name for row in found.status for status in row} == {"OK"}

    def test_and_their_signs(self):
        made, (one,) = looks(1)
        signs = [(1, 1), (-1, 1), (1, -1), (-1, -1)]
        cameras = [
            {**one, **{name: one[name] * sign for name in ("read", "commanded")}} for sign in signs
        ]
        found = calibrate(*cameras, priors=replace(PRIORS, axis_scale_sigma=0.02))
        assert found.axis_scale.sign().tolist() == [list(sign) for sign in signs]
        off = (found.focal_length - torch.from_numpy(made.focal)) / found.focal_length_sigma
        assert off.abs().max() < 4

    def test_the_pixel_aspect_is_found(self):
        made, cameras = looks(1, aspect=1.03, draws=4)
        found = calibrate(*cameras, priors=replace(PRIORS, pixel_aspect_sigma=0.05))
        sigma = found.head_sigma["pixel aspect"]
        assert (sigma < 1e-3).all()
        assert ((found.pixel_aspect.log() - math.log(1.03)) / sigma).abs().max() < 4
        off = (found.focal_length - torch.from_numpy(made.focal)) / found.focal_length_sigma
        assert off.abs().max() < 4

    def test_one_for_each_camera(self):
        """Two cameras with different priors are two calls."""
        first, second = looks(0, grid=(5, 4))[1][0], looks(1, grid=(5, 4))[1][0]
        each = replace(PRIORS, distance_m=torch.tensor([12.0, 6.0]), pupil_m=torch.tensor([0, 0.1]))
        together = calibrate(first, second, priors=each)
        alone = calibrate(second, priors=replace(PRIORS, distance_m=6.0, pupil_m=0.1))
        different = differences(together, 1, alone, 0)
        assert max(different.values()) < 1e-7, different


BODIES = {
    "one zoom": {"zooms": (1.0,)},
    "the long end alone": {"zooms": (25.0,)},
    "five zooms": {"zooms": (1.0, 2.0, 5.0, 12.0, 25.0)},
    "strong barrel": {"barrel": (0.1, 0.25, 0.1)},
    "pincushion": {"barrel": (-0.1, -0.05, 0.0)},
    "wide": {"wide": 400.0, "barrel": (0.1, 0.25, 0.1)},
    "long": {"wide": 3000.0},
    "far below": {"ray": np.array([[0.4, math.radians(70)]])},
    "nearly straight below": {"ray": np.array([[0.4, math.radians(80)]])},
    "behind": {"ray": np.array([[math.pi - 0.01, 0.3]])},
    "mounted askew": {"tilt_zero": 0.05, "boresight": -0.05, "roll": 0.1},
    "play": {"backlash": (2e-3, 3e-3)},
    "portrait": {"size": (544, 736)},
}


class TestBodies:
    """Cameras that are hard to start with, or see little."""

    @pytest.mark.parametrize("body", BODIES.values(), ids=BODIES)
    def test_are_calibrated(self, body):
        """With a head of coarse steps, of fine ones, and of none."""
        if "size" in body:
            made = head_body.body(3)
            middle = np.array([272.0, 368.0]) - (368.0, 272.0)
            made = replace(made, point=made.point + middle, center=made.center + middle, **body)
        else:
            made = head_body.body(3, **body)
        cameras = []
        for quantum in (head_body.QUANTUM, head_body.FINE, (0.0, 0.0)):
            planned = head_body.plan(made, quantum=quantum, grid=(7, 5))
            cameras += head_body.looks(made, planned)
        found = calibrate(*cameras)
        names = {status.name for row in found.status for status in row}
        assert names <= {"OK", "DISTORTION_UNOBSERVABLE"}
        off = (found.focal_length - torch.from_numpy(made.focal)) / found.focal_length_sigma
        assert off.abs().max() < 4.5
        seen = Observations.from_lists(cameras).found
        assert found.inliers.sum() >= 0.98 * seen.sum()

    def test_a_sensor_on_its_side(self):
        _, cameras = looks(3, roll=math.pi / 2)
        found = calibrate(*cameras, priors=replace(PRIORS, roll_sigma=3.0))
        assert found.roll.item() == pytest.approx(math.pi / 2, abs=1e-3)
        assert {status.name for status in found.status[0]} == {"OK"}

    def test_a_zoom_with_three_looks(self):
        """Its principal point and head are known from the others: it has a focal length."""
        made, (one,) = looks(1, grid=(9, 7))
        own = one["zoom"] == 5
        lost = own & (np.cumsum(own) % 30 != 5)
        one["pixel"] = np.where(lost[:, None], np.nan, one["pixel"])
        found = calibrate(one)
        assert [status.name for status in found.status[0]] == ["OK", "TOO_FEW_LINES", "OK"]
        assert found.focal_length[0, 1].item() == pytest.approx(made.focal[1], rel=0.1)
        off = (found.focal_length[0] - torch.from_numpy(made.focal)) / found.focal_length_sigma[0]
        assert off.abs().max() < 4


class TestInput:
    @pytest.mark.parametrize("device", DEVICES)
    def test_device_and_dtype_are_kept(self, device):
        _, cameras = looks(0, grid=(5, 4))
        seen = Observations.from_lists(cameras)
        found = tp.calibrate(seen.to(device), PRIORS)
        reference = tp.calibrate(seen, PRIORS)
        for name in ("theta", "covariance", "focal_length", "residuals", "inliers", "pairs"):
            assert getattr(found, name).device.type == device, name
        assert found.lens.center.device.type == device
        assert found.theta.dtype == torch.float64
        off = (found.focal_length.cpu() - reference.focal_length) / reference.focal_length_sigma
        assert off.abs().max() < 1e-3
        assert len(found.undetermined) == 1

    def test_nothing_of_it_is_changed(self):
        _, cameras = looks(0, grid=(5, 4))
        seen = Observations.from_lists(cameras)
        before = {name: getattr(seen, name).clone() for name in ("read", "pixel", "sigma", "found")}
        tp.calibrate(seen, PRIORS)
        for name, value in before.items():
            torch.testing.assert_close(getattr(seen, name), value, rtol=0, atol=0)

    def test_no_gradients_are_kept(self):
        _, cameras = looks(0, grid=(5, 4))
        assert not calibrate(*cameras).theta.requires_grad

    def test_priors_have_defaults(self):
        made, cameras = looks(1)
        found = tp.calibrate(Observations.from_lists(cameras))
        assert {status.name for status in found.status[0]} == {"OK"}
        off = (found.focal_length[0] - torch.from_numpy(made.focal)) / found.focal_length_sigma[0]
        assert off.abs().max() < 4
