"""The benchmark's section on imperfect heads: its simulated cameras, its figures, its checks."""

from __future__ import annotations

import copy
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchptz.calibration import Priors
from torchptz.geometry import pan_rotation, tilt_rotation
from torchptz.lens import RadialLens
from torchptz.observations import Observations
from torchptz.simulation.view import HeadPose, Mount, View

TWISTED = {"tilt_zero_deg": 0.5, "boresight_deg": 0.3, "roll_deg": 2.0, "pupil_m": 0.05}


@pytest.fixture(scope="module")
def body(load):
    return load("head.body")


@pytest.fixture(scope="module")
def mechanics(load):
    return load("head.mechanics")


@pytest.fixture(scope="module")
def collection(load):
    return load("head.collection")


@pytest.fixture(scope="module")
def measure(load):
    return load("head.measure")


@pytest.fixture(scope="module")
def section(load):
    return load("head.imperfections")


def poses_near(camera, count=40, spread=0.1):
    """Poses (count, 2) rad that show the feature at the wide end."""
    rng = np.random.default_rng(0)
    return camera.direction + rng.uniform(-spread, spread, (count, 2))


def number(value):
    """(1,) of it."""
    return torch.tensor([value], dtype=torch.float64)


class TestBody:
    def test_it_sees_what_the_simulator_sees(self, body):
        flaws = body.Imperfections(**TWISTED, pixel_aspect=0.9, other_lens=True)
        camera = body.Body.random(5, body.RZ30, flaws)
        # The mount is Rz(roll) Rx(down) Ry(left).
        down = math.asin(camera.mount[2, 1])
        left = math.atan2(-camera.mount[2, 0], camera.mount[2, 2])
        roll = math.atan2(-camera.mount[0, 1], camera.mount[1, 1])
        sizes = [math.degrees(abs(one)) for one in (left, down, roll)]
        assert sizes == pytest.approx([0.3, 0.3, 2.0])
        mount = Mount((left, down), roll, float(camera.pupil[0]))
        feature = camera.distance * body.ray(*camera.direction)
        poses = poses_near(camera)
        for pose, seen in zip(poses, camera.see(poses, 0), strict=True):
            there = HeadPose(pose[0], pose[1] + camera.tilt_zero, 0.0)
            view = View.at(camera.lenses[0], mount, there)
            np.testing.assert_allclose(seen, view.project(feature[None])[0], atol=1e-9)

    def test_its_turns_are_those_of_the_calibration(self, body):
        camera = body.Body.random(2, body.FINE, body.Imperfections(**TWISTED))
        turns = {name: torch.tensor(value).double() for name, value in camera.turns.items()}
        c, s = math.cos(turns["roll"]), math.sin(turns["roll"])
        about_z = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
        down = tilt_rotation(turns["down"] - camera.tilt_zero)
        turned = about_z @ pan_rotation(turns["left"]) @ down
        np.testing.assert_allclose(turned, camera.mount, atol=1e-12)
        assert abs(math.degrees(camera.tilt_zero)) == pytest.approx(0.5)

    def test_rows_differ_in_what_is_wrong_alone(self, body):
        one = body.Body.random(3, body.RZ30, body.Imperfections())
        other = body.Body.random(3, body.FINE, body.Imperfections(**TWISTED, jitter=1))
        for name in ("focal_length", "principal_point", "direction", "distance"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        assert not np.allclose(
            one.focal_length, body.Body.random(4, body.RZ30, body.Imperfections()).focal_length
        )

    def test_a_population_is_that_of_the_priors(self, body):
        cameras = [body.Body.from_priors(seed, body.RZ30) for seed in range(300)]
        priors = Priors()

        def spread(values):
            return float(np.sqrt(np.mean(np.square(values))))

        for name, sigma in (
            ("down", priors.tilt_zero_sigma),
            ("left", priors.boresight_sigma),
            ("roll", priors.roll_sigma),
        ):
            assert spread([one.turns[name] for one in cameras]) == pytest.approx(sigma, rel=0.15)
        pupils = [one.pupil for one in cameras]
        assert spread(pupils) == pytest.approx(priors.pupil_sigma_m, rel=0.15)
        points = np.array([one.principal_point for one in cameras])
        wander = points - points.mean(1, keepdims=True)
        expected = priors.wander_sigma * math.sqrt(4 / 5)
        assert spread(wander) == pytest.approx(expected, rel=0.15)
        beside = [
            lens.lens.center[0].numpy() - point
            for one in cameras
            for lens, point in zip(one.lenses, one.principal_point, strict=True)
        ]
        assert spread(beside) == pytest.approx(priors.decentering_sigma, rel=0.15)
        play = [np.radians(one.imperfections.backlash_deg) for one in cameras]
        assert spread(play) == pytest.approx(priors.backlash_sigma, rel=0.15)
        told = [one.told_distance / one.distance - 1 for one in cameras]
        assert spread(told) == pytest.approx(0.05, rel=0.15)

    def test_lenses_of_either_form_bend_from_barrel_to_pincushion(self, body):
        corner = np.array([[0.0, 0.0]])
        for other_lens in (False, True):
            camera = body.Body.random(1, body.RZ30, body.Imperfections(other_lens=other_lens))
            for lens in camera.lenses:
                np.testing.assert_allclose(lens.undistort(lens.distort(corner)), corner, atol=1e-8)
            outwards = [float((-lens.undistort(corner)).sum()) for lens in camera.lenses]
            assert outwards[0] > 10 > 0 > outwards[-1]


class TestMechanics:
    def go(self, body, mechanics, poses, seed=0, **flaws):
        camera = body.Body.random(0, body.RZ30, body.Imperfections(**flaws))
        return camera, mechanics.Mechanics(camera, np.random.default_rng(seed)).go(np.array(poses))

    def test_a_perfect_head_is_where_it_reads(self, body, mechanics):
        poses = [(0.1, 0.2), (0.3, -0.1)]
        assert self.go(body, mechanics, poses)[1].tolist() == [list(pose) for pose in poses]

    def test_the_load_follows_when_the_play_is_used_up(self, body, mechanics):
        play = math.radians(0.05)
        up, less = 0.2 + play / 4, 0.2 - play / 2
        poses = [(0.1, 0.1), (0.2, 0.2), (up, up), (less, less), (0.0, 0.0)]
        stops = self.go(body, mechanics, poses, backlash_deg=0.05)[1][1:, 0]
        expected = [0.2 - play / 2, up - play / 2, up - play / 2, play / 2]
        np.testing.assert_allclose(stops, expected, atol=1e-12)

    def test_a_stop_errs_by_its_jitter_once(self, body, mechanics):
        rng = np.random.default_rng(1)
        poses = np.repeat(rng.uniform(-1, 1, (4000, 2)), 2, axis=0)
        camera, stops = self.go(body, mechanics, poses, jitter=1.5)
        errors = stops - poses
        np.testing.assert_array_equal(errors[::2], errors[1::2])
        np.testing.assert_allclose(errors.std(0), camera.reading_sigma, rtol=0.03)
        assert (np.abs(errors) <= 0.75 * np.array(body.RZ30.quantum)).all()


@pytest.fixture(scope="module")
def looks(body, collection):
    """A twisted camera, and what is seen of it."""
    flaws = body.Imperfections(**TWISTED, jitter=0.3, backlash_deg=0.02)
    camera = body.Body.random(1, body.RZ30, flaws)
    return camera, collection.collect(camera, lines=(4, 4), points=9).looks


class TestCollection:
    def test_its_order_is_the_collectors(self, looks):
        _, looks = looks
        observations = Observations.from_lists([looks])
        line, zoom = observations.line[0], observations.zoom[0]
        assert (zoom[:9] == 4).all()
        assert (line[:9] == -1).all()
        tracks = int((line == -1).sum()) - 9
        on_tracks = slice(9, 9 + tracks)
        assert len(observations.stop[0, on_tracks].unique()) >= 8
        # From the longest zoom outwards while the head stands still.
        first = int((observations.found[0, on_tracks] & (zoom[on_tracks] == 4)).nonzero()[0]) + 9
        assert zoom[first : first + 5].tolist() == [4, 3, 2, 1, 0]
        assert len(observations.stop[0, first : first + 5].unique()) == 1
        scanned = zoom[9 + tracks :]
        assert (scanned.diff() >= 0).all()
        for level in range(5):
            numbers = line[9 + tracks :][scanned == level]
            assert (numbers.diff() >= 0).all()
            assert len(numbers.unique()) == 8

    def test_the_head_is_sent_to_its_grid_and_the_feature_found_in_the_picture(self, looks):
        camera, looks = looks
        steps = looks["commanded"] / camera.head.quantum
        assert np.abs(steps - np.rint(steps)).max() < 1e-6
        found = np.isfinite(looks["pixel"]).all(1)
        assert 0.9 < found.mean() < 1
        assert (looks["pixel"][found] > 3).all()

    def test_offsets_tell_how_far_beside_its_line_a_point_is(self, body, collection, measure):
        camera = body.Body.random(0, body.RZ30, body.Imperfections(), zooms=(5,))
        collected = collection.collect(camera, sigma=0.0)

        def crooked(share):
            rest = []
            for line in collected.lines[0]:
                points = camera.lenses[0].undistort(line.points) - share * line.offsets
                values = np.linalg.svd(points - points.mean(0), compute_uv=False)
                rest.append(values[-1] / math.sqrt(len(points)))
            return max(rest)

        assert crooked(0.0) > 0.5
        assert crooked(1.0) < 0.02

    def test_repeats_itself(self, looks, collection):
        camera, looks = looks
        again = collection.collect(camera, lines=(4, 4), points=9).looks
        for name in ("read", "pixel"):
            np.testing.assert_array_equal(again[name], looks[name])


class TestMeasure:
    def test_largest_errors(self, measure):
        wanted = measure.places((5, 4))[None] - 300
        turn = np.array([[0.8, -0.6], [0.6, 0.8]])
        similar = 0.9 * wanted @ turn.T + 5
        assert measure.largest_errors(similar, wanted, similar=True)[0] < 1e-9
        assert measure.largest_errors(similar, wanted, similar=False)[0] > 100
        bent = wanted.copy()
        bent[0, 3] += (3.0, 4.0)
        assert measure.largest_errors(bent, wanted, similar=False)[0] == pytest.approx(5.0)
        bent[0, 0] = np.nan
        assert measure.largest_errors(bent, wanted, similar=True)[0] == np.inf

    def test_what_is_not_finite_is_not_covered(self, measure):
        errors = measure.Errors(np.array([1.9, -2.0, np.nan, 1.0]), np.array([1, 1, 1, np.nan]))
        assert errors.covered.tolist() == [True, False, False, False]

    def found(self, camera, **changed):
        """What a calibration that knows the truth to some sigma would be."""
        lenses = [lens.lens for lens in camera.lenses]
        lens = RadialLens(
            torch.cat([one.center for one in lenses]),
            torch.cat([one.coefficients for one in lenses]),
            lenses[0].powers,
            None,
            lenses[0].image_size[0],
        )
        covariance = torch.zeros(len(lenses), 8, 8, dtype=torch.float64)
        covariance[:, 0, 0], covariance[:, 6, 6], covariance[:, 7, 7] = 0.04, 1.0, 4.0
        truth = {
            "focal_length": torch.from_numpy(camera.focal_length)[None],
            "focal_length_sigma": torch.from_numpy(camera.focal_length)[None] / 100,
            "principal_point": torch.from_numpy(camera.principal_point)[None],
            "exists": torch.ones(1, len(lenses), dtype=torch.bool),
            "lens": lens,
            "intrinsics_covariance": covariance,
            "lens_covariance": covariance[:, :5, :5],
            "tilt_zero": number(camera.turns["down"]),
            "boresight": number(camera.turns["left"]),
            "roll": number(camera.turns["roll"]),
            "head_sigma": {name: number(0.1) for name in ("tilt zero", "boresight", "roll")},
        }
        return SimpleNamespace(**(truth | changed))

    def test_errors_are_those_against_the_truth(self, body, measure):
        camera = body.Body.random(0, body.RZ30, body.Imperfections(**TWISTED), zooms=(1, 5))
        exact = measure.errors_of(self.found(camera), [camera])
        for name, one in exact.items():
            assert np.abs(one.error).max() < 1e-9, name
            assert one.covered.all()
        np.testing.assert_allclose(exact["focal length"].sigma, [[0.01, 0.01]])
        np.testing.assert_allclose(exact["principal point"].sigma, [[[1, 2], [1, 2]]])
        assert exact["undistorted place"].error.shape == (1, 2, 25, 2)

        longer = self.found(
            camera,
            focal_length=torch.from_numpy(camera.focal_length)[None] * 1.03,
            roll=number(camera.turns["roll"] + 0.3),
        )
        off = measure.errors_of(longer, [camera])
        np.testing.assert_allclose(off["focal length"].error, [[0.03, 0.03]])
        assert not off["focal length"].covered.any()
        assert not off["roll"].covered.any()
        assert off["left"].covered.all()

    def test_the_sigma_of_a_place_is_how_far_the_centre_moves_it(self, body, measure):
        camera = body.Body.random(0, body.RZ30, body.Imperfections(), zooms=(1,))
        found = self.found(camera)
        step = 0.2
        moved = RadialLens(
            found.lens.center + torch.tensor([step, 0.0]),
            found.lens.coefficients,
            found.lens.powers,
            None,
            found.lens.image_size[0],
        )
        shift = measure.undistorted(moved, measure.SPARSE) - measure.undistorted(
            found.lens, measure.SPARSE
        )
        sigma = measure.errors_of(found, [camera])["undistorted place"].sigma[0]
        np.testing.assert_allclose(sigma, np.abs(shift), rtol=0.02, atol=1e-4)


@pytest.fixture(scope="module")
def result(section, body):
    """The section's quick run on one head, two zooms, and rows of every kind."""
    rows = ("none", "ray off by 5 px", "tilt zero 0.5°", "pupil 1 % of the distance")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(section, "ZOOMS", (1, 12))
        patch.setattr(section, "HEADS", (body.RZ30,))
        patch.setattr(section, "QUICK_ROWS", rows)
        yield section.run(quick=True)


def cell_of(result, row):
    return next(cell for cell in result["cells"] if cell["row"] == row)


class TestSection:
    def test_figures_are_plain_and_in_the_tables(self, section, result):
        json.dumps(result, allow_nan=False)
        assert [cell["head"] for cell in result["cells"]] == ["RZ30"] * 4
        tables = section.table(result)
        for cell in result["cells"]:
            count = tables.count(f"| RZ30 | {cell['row']} |")
            assert count == (2 if cell["complete"] else 1)

    def test_a_head_that_is_off_harms_the_lines_alone(self, result):
        perfect, off = cell_of(result, "none"), cell_of(result, "tilt zero 0.5°")
        assert off["lines"]["similar_px"][0] > 1.0
        assert off["complete"]["similar_px"][0] < 0.3
        assert off["complete"]["raw_px"][0] >= off["complete"]["similar_px"][0]
        ray = cell_of(result, "ray off by 5 px")
        assert ray["lines"]["similar_px"][0] > 2.0 > 1.0 > perfect["lines"]["similar_px"][0]

    def test_a_pupil_is_told_as_a_sigma_of_the_focal_length(self, result):
        pupil = cell_of(result, "pupil 1 % of the distance")["complete"]
        assert pupil["focal_sigma_percent"][0] == pytest.approx(1.0, rel=0.1)
        assert pupil["focal_percent"][0] == pytest.approx(1.0, rel=0.2)
        assert cell_of(result, "none")["complete"]["focal_sigma_percent"][0] < 0.1
        assert "entrance pupil" in pupil["undetermined"]

    def test_all_promises_hold_but_that_two_cameras_prove_no_share(self, section, result):
        checks = section.checks(result)
        assert [name for name, ok in checks.items() if not ok] == []
        assert len(checks) == 5
        assert not any("intervals" in name for name in checks)

    @pytest.mark.parametrize(
        ("row", "change", "failing"),
        [
            ("tilt zero 0.5°", {"similar_px": [None, 0.1]}, "of a perfect head"),
            ("tilt zero 0.5°", {"similar_px": [99.0, 0.1]}, "no worse than from lines"),
            ("pupil 1 % of the distance", {"focal_sigmas": [2.5, 1.0]}, "sigmas off as the pupil"),
            ("pupil 1 % of the distance", {"focal_sigma_percent": [0.5, 1.0]}, "of the pupil"),
        ],
    )
    def test_checks_fail_where_the_figures_do(self, section, result, row, change, failing):
        worse = copy.deepcopy(result)
        cell_of(worse, row)["complete"] |= change
        assert any(failing in name for name, ok in section.checks(worse).items() if not ok)

    @pytest.mark.parametrize(
        ("drawn", "share", "holds"),
        [(False, 0.89, False), (False, 1.0, True)]
        + [(True, 0.89, False), (True, 0.95, True), (True, 1.0, False)],
    )
    def test_intervals_hold_the_truth_as_often_as_they_say(
        self, section, result, drawn, share, holds
    ):
        many = copy.deepcopy(result)
        cell = cell_of(many, "none")
        if drawn:
            cell = copy.deepcopy(cell) | {"row": section.DRAWN}
            many["cells"].append(cell)
        cell["cameras"] = 20
        for name in section.TURNS:
            cell["complete"]["coverage"][name] = {"covered": [100 * share], "of": [100]}
        assert f"{share:.1%} | {share:.1%} | {share:.1%} |" in section.table(many) or not drawn
        found = {name: ok for name, ok in section.checks(many).items() if "turns of the" in name}
        assert list(found.values()) == [holds]

    def test_a_zoom_that_a_calibration_lacks_is_beyond_measure(self, measure):
        found = SimpleNamespace(exists=torch.tensor([[True, False], [True, True]]))
        values = measure.of_pairs(found, np.arange(6.0).reshape(3, 2))
        np.testing.assert_array_equal(values[[0, 2, 3]], [[0, 1], [2, 3], [4, 5]])
        assert np.isnan(values[1]).all()
