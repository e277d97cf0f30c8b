"""The choice of the next views, against covariances from scratch, brute force and `calibrate`."""

from dataclasses import replace
from itertools import combinations, permutations

import numpy as np
import pytest
import torch

from tests import head_body
from torchptz.calibration import Priors, calibrate
from torchptz.calibration import parameters as at
from torchptz.calibration.candidates import Reach, Views, candidates, problem_of
from torchptz.calibration.design import choose, exhausted, largest_sigma, whitened
from torchptz.calibration.model import predict
from torchptz.calibration.problem import Problem
from torchptz.calibration.route import Costs, Start, Travel, in_order

SIGMA, READING = 0.1, 3e-4  # px, rad
MARGIN = 15.0
# Gains alone decide: neither travel nor zoom take time worth mentioning.
FREE = Costs(look_s=1.0, speed=1e9, zoom_s=0.0)
PRIORS = Priors(
    distance_m=12.0,
    pupil_sigma_m=0.003,
    backlash_sigma=0.0,
    repeatability=READING,
    reading_known=True,
)


def bodies(features=1, **changed):
    """Two cameras."""
    return [head_body.body(seed, (1.0, 5.0), features=features, **changed) for seed in (3, 4)]


def seen(made, more=None, grid=(4, 3)):
    """What a camera of a continuous head saw: a few looks, and then those of (pose, zoom,
    feature)."""
    planned = head_body.plan(made, quantum=(0.0, 0.0), grid=grid, tracks=4)
    if more is not None:
        pose, zoom, feature = more
        planned = replace(
            planned,
            commanded=np.concatenate([planned.commanded, pose]),
            zoom=np.concatenate([planned.zoom, zoom]),
            feature=np.concatenate([planned.feature, feature]),
            line=np.concatenate([planned.line, np.full(len(zoom), -1)]),
        )
    return head_body.looks(made, planned, sigma=SIGMA, reading=READING)


def known(*looks, priors=PRIORS):
    return calibrate(
        head_body.Observations.from_lists([one for each in looks for one in each]), priors
    )


def anywhere(c, quantum=0.0):
    return Reach.anywhere(torch.full((len(c), 2), quantum, dtype=torch.float64))


@pytest.fixture(scope="module")
def found():
    """A calibration of two cameras with a feature each."""
    return known(*map(seen, bodies()))


@pytest.fixture(scope="module")
def views(found):
    return candidates(found, anywhere(found), MARGIN, places=(4, 3))


@pytest.fixture(scope="module")
def two():
    """The same with two features each."""
    return known(*map(seen, bodies(2, ray=np.array([[0.3, 0.1], [0.1, 0.4]]))))


def taken(design, camera):
    """Looks of a camera in their order: poses, zooms and features."""
    mask = design.views.mask[camera]
    stop, look = mask.nonzero().unbind(1)
    one = design.views[camera]
    return (
        one.pose[0, stop].numpy(),
        one.zoom[0, stop, look].numpy(),
        one.feature[0, stop, look].numpy(),
    )


def scratch(c, rows):
    """Covariances of all unknowns with rows (C, R, T) more, by inverting the information."""
    out = torch.zeros_like(c.covariance)
    for camera, free in enumerate(c.known.free):
        both = free[:, None] & free
        size = int(free.sum())
        before = c.covariance[camera][both].reshape(size, size)
        told = rows[camera][:, free]
        out[camera][both] = torch.linalg.inv(torch.linalg.inv(before) + told.T @ told).flatten()
    return out


def slow_level(c, covariance, part="all"):
    """(C, Z, G) px² by the lens's own displacement sigma."""
    changed = replace(c, covariance=covariance)
    share = torch.cartesian_prod(torch.linspace(0, 1, 7), torch.linspace(0, 1, 5)).double()
    places = share * (c.lens.image_size[:, None] - 1)
    sigma = c.lens.displacement_sigma(places, changed.lens_covariance, part)
    return sigma.reshape(len(c), -1, len(share)) ** 2


class TestWhitened:
    @pytest.mark.parametrize("case", ["found", "two"])
    def test_as_with_the_dense_covariance_of_each_stop(self, case, request):
        c = request.getfixturevalue(case)
        views = candidates(c, anywhere(c), MARGIN, places=(4, 3))
        rows = whitened(c, views, SIGMA)
        problem, theta = problem_of(c, views)
        prediction = predict(problem, theta)
        looks = views.zoom.shape[2]
        columns = torch.zeros(*problem.zoom.shape, 2, c.layout.size, dtype=torch.float64)
        index = c.layout.index(problem.zoom, problem.feature)
        columns.scatter_(3, index[:, :, None].expand_as(prediction.by_theta), prediction.by_theta)
        counts = set()
        for camera in range(len(c)):
            for view in views.exists[camera].nonzero()[:, 0].tolist():
                which = view * looks + views.mask[camera, view].nonzero()[:, 0]
                a = columns[camera, which].flatten(0, 1)
                b = prediction.by_pose[camera, which].flatten(0, 1)
                noise = SIGMA**2 * c.noise_factor[camera] ** 2 * torch.eye(len(a))
                noise = noise + b @ torch.diag(c.reading_sigma[camera] ** 2) @ b.T
                play = slice(c.layout.zooms * c.layout.per_zoom + at.BACKLASH.start, None)
                a[:, play.start : play.start + 2] = 0  # no axis has any here
                wanted = a.T @ torch.linalg.inv(noise) @ a
                got = rows[camera, view].T @ rows[camera, view]
                assert torch.allclose(got, wanted, rtol=1e-7, atol=1e-7 * float(wanted.abs().max()))
                counts.add(len(which))
        assert counts == ({1, 2} if case == "found" else {1, 2, 3})

    def test_play_is_that_of_a_head_that_comes_from_below(self):
        """Against the model's own play operator, over a stop below each."""
        made = head_body.body(3, (1.0, 5.0), backlash=(2e-3, 1e-3))
        c = known(seen(made), priors=replace(PRIORS, backlash_sigma=2e-3))
        assert (c.backlash > 2e-4).all()
        views = candidates(c, anywhere(c), MARGIN, places=(3, 2), pairs=False)
        assert (views.upwards == 1).all()
        assert (views.run_up >= c.backlash[:, None]).all()
        problem, theta = problem_of(c, views)
        two = torch.stack([views.pose - views.run_up, views.pose], 2).flatten(1, 2)
        count = two.shape[1]
        real = Problem(
            *(problem.layout, count, problem.powers),
            *(
                one.repeat_interleave(2, 1)
                for one in (problem.pixel[:, ::2], problem.sigma[:, ::2])
            ),
            torch.ones(1, count, dtype=torch.float64),
            *(one[:, ::2].repeat_interleave(2, 1) for one in (problem.zoom, problem.feature)),
            torch.arange(count)[None],
            two,
            problem.scale,
            problem.image_size,
        )
        wanted = predict(real, c.theta)
        there = predict(problem, theta)
        assert torch.allclose(there.pixel[:, ::2], wanted.pixel[:, 1::2], atol=1e-9)
        rows = whitened(c, views, SIGMA)
        place = c.layout.zooms * c.layout.per_zoom + at.BACKLASH.start
        compact = c.layout.per_zoom + at.BACKLASH.start
        for view in views.exists[0].nonzero()[:, 0].tolist():
            b = wanted.by_pose[0, 2 * view + 1]
            noise = (
                SIGMA**2 * c.noise_factor[0] ** 2 * torch.eye(2)
                + b @ torch.diag(c.reading_sigma[0] ** 2) @ b.T
            )
            a = wanted.by_theta[0, 2 * view + 1][:, compact : compact + 2]
            got = rows[0, view][:, place : place + 2]
            assert torch.allclose(got.T @ got, a.T @ torch.linalg.inv(noise) @ a, rtol=1e-6)

    def test_a_wide_look_tells_where_a_long_one_stopped(self, found, views):
        """A pair says more than its looks would at stops of their own."""
        rows = whitened(found, views, SIGMA)
        first, last = views.zooms
        pair = ((first != last) & views.exists)[0].nonzero()[0, 0]
        pose = views.pose[0, pair]
        own = [
            int(
                ((views.pose[0] == pose).all(-1) & (first[0] == z) & (last[0] == z)).nonzero()[0, 0]
            )
            for z in (1,)
        ]
        alone = rows[0, own[0]]
        wide = replace(views, mask=views.mask & (views.zoom == first[:, :, None]))
        other = whitened(found, wide, SIGMA)[0, pair]
        covariance = found.covariance[0]

        def told(rows):
            """How far the determinant falls."""
            inner = torch.eye(len(rows)) + rows @ covariance @ rows.T
            return float(torch.linalg.slogdet(inner).logabsdet)

        assert told(rows[0, pair]) > told(torch.cat([alone, other])) + 0.5


class TestChoice:
    @pytest.mark.parametrize("criterion", ["largest", "volume"])
    def test_the_covariance_is_that_from_scratch(self, found, views, criterion):
        design = choose(found, views, 9, SIGMA, criterion=criterion)
        assert (design.picked >= 0).all()
        rows = whitened(found, views, SIGMA)
        rows = torch.stack([one[index] for one, index in zip(rows, design.picked, strict=True)])
        wanted = scratch(found, rows.flatten(1, 2))
        size = wanted.diagonal(dim1=1, dim2=2).sqrt()
        scale = size[:, :, None] * size[:, None] + 1e-300
        assert ((design.covariance - wanted).abs() / scale).max() < 1e-6

    @pytest.mark.parametrize("part", ["all", "lines"])
    def test_sigmas_are_the_lens_s_own(self, found, views, part):
        design = choose(found, views, 5, SIGMA, part=part)
        for covariance, got in (
            (found.covariance, design.sigma[:, 0]),
            (found.covariance, largest_sigma(found, part)),
            (design.covariance, design.sigma[:, -1]),
        ):
            wanted = slow_level(found, covariance, part).amax(2).sqrt()
            assert torch.allclose(got, wanted, rtol=1e-6)

    def test_what_the_powers_cannot_follow_is_in_the_sigmas(self, found, views):
        misfit = torch.zeros_like(found.misfit)
        misfit[:, 1, 0, 0], misfit[:, 1, 3, 3] = 25.0, 1e-3
        other = replace(found, misfit=misfit)
        design = choose(other, views, 5, SIGMA)
        assert torch.allclose(largest_sigma(other), design.sigma[:, 0])
        for covariance, got in (
            (found.covariance, design.sigma[:, 0]),
            (design.covariance, design.sigma[:, -1]),
        ):
            wanted = slow_level(other, covariance).amax(2).sqrt()
            assert torch.allclose(got, wanted, rtol=1e-6)
        alone = largest_sigma(replace(other, covariance=torch.zeros_like(other.covariance)))
        assert (alone[:, 1] > 1.0).all()
        left = exhausted(other, views, SIGMA, 1e6)
        assert (largest_sigma(other, covariance=left) >= alone).all()

    @pytest.mark.parametrize("criterion", ["largest", "volume"])
    @pytest.mark.parametrize("costs", [FREE, Costs(look_s=0.5, speed=0.5, zoom_s=1.5)])
    def test_each_choice_is_the_best_of_all_by_brute_force(self, found, criterion, costs):
        c = found[0:1]
        views = candidates(c, anywhere(c), MARGIN, places=(3, 3))
        start = Start(torch.tensor([[0.1, 0.2]], dtype=torch.float64), torch.tensor([1]))
        design = choose(c, views, 4, SIGMA, costs=costs, start=start, criterion=criterion)
        rows = whitened(c, views, SIGMA)[0]

        def worth(covariance):
            if criterion == "volume":
                free = c.known.free[0]
                return -torch.linalg.slogdet(covariance[0][free][:, free]).logabsdet
            return -slow_level(c, covariance).pow(16).mean().log() / 16

        chosen = []
        for pick in design.picked[0].tolist():
            now = scratch(c, torch.cat([rows[chosen].flatten(0, 1), rows[:0].flatten(0, 1)])[None])
            used = [tuple(views.pose[0, one].tolist()) for one in chosen]
            values = {}
            for view in views.exists[0].nonzero()[:, 0].tolist():
                if tuple(views.pose[0, view].tolist()) in used:
                    continue
                after = scratch(c, rows[[*chosen, view]].flatten(0, 1)[None])
                values[view] = float(
                    (worth(after) - worth(now)) / self.price(views, view, chosen, start, costs)
                )
            best = max(values, key=values.get)
            assert values[pick] == pytest.approx(values[best], rel=1e-6)
            chosen.append(pick)

    @staticmethod
    def price(views, view, chosen, start, costs):
        """What a view takes, from the nearest place that is visited anyway."""
        first, last = (int(zoom[0, view]) for zoom in views.zooms)
        poses = [start.pose[0], *(views.pose[0, one] for one in chosen)]
        zooms = {int(start.zoom[0])} | {int(z[0, one]) for one in chosen for z in views.zooms}
        away = min(float((views.pose[0, view] - pose).abs().max()) for pose in poses)
        changes = max(len({first, last} - zooms), int(first != last))
        looks = int(views.mask[0, view].sum())
        return costs.look_s * looks + away / costs.speed + costs.zoom_s * changes

    def test_three_choices_are_nearly_the_best_three(self, found):
        """Greedy is not optimal, but of all triples few are better, and not by much."""
        c = found[0:1]
        views = candidates(c, anywhere(c), MARGIN, places=(3, 3), pairs=False)
        design = choose(c, views, 3, SIGMA, costs=FREE)
        rows = whitened(c, views, SIGMA)[0]
        exists = views.exists[0].nonzero()[:, 0].tolist()
        largest = [
            float(slow_level(c, scratch(c, rows[list(three)].flatten(0, 1)[None])).max()) ** 0.5
            for three in combinations(exists, 3)
        ]
        got = float(design.sigma[0, -1].max())
        assert got < 1.1 * min(largest)
        assert np.mean(np.array(largest) < got) < 0.02

    def test_cameras_are_independent(self, found, views):
        costs = Costs()
        together = choose(found, views, 6, SIGMA, costs=costs)
        for camera in range(2):
            alone = choose(found[camera], views[camera], 6, SIGMA, costs=costs)
            assert alone.picked.tolist() == together.picked[camera : camera + 1].tolist()
            assert torch.equal(alone.views.pose[0], together.views.pose[camera])
            assert torch.allclose(alone.covariance[0], together.covariance[camera], rtol=1e-9)

    @pytest.mark.parametrize("part", ["all", "lines"])
    def test_a_camera_of_which_nothing_is_known_changes_nothing(self, found, views, part):
        covariance = found.covariance.clone()
        covariance[0] = torch.nan
        bad = replace(found, covariance=covariance)
        design = choose(bad, views, 4, SIGMA, part=part)
        alone = choose(found[1], views[1], 4, SIGMA, part=part)
        assert (design.picked[0] == -1).all()
        assert not design.views.exists[0].any()
        assert design.picked[1:].tolist() == alone.picked.tolist()
        assert torch.allclose(design.sigma[1:], alone.sigma)
        shown = candidates(bad, anywhere(bad), MARGIN, places=(4, 3))
        assert torch.equal(shown.mask[1], views.mask[1])

    def test_no_pose_twice(self, found, views):
        design = choose(found, views, 30, SIGMA, costs=FREE)
        for camera in range(2):
            there = design.views.exists[camera]
            poses = {tuple(pose) for pose in design.views.pose[camera, there].tolist()}
            assert len(poses) == int(there.sum()) == int((design.picked[camera] >= 0).sum())

    def test_it_ends_at_the_goal(self, found, views):
        free = choose(found, views, 12, SIGMA)
        goal = float(free.sigma[0, 5].max()) * 1.0001
        design = choose(found, views, 12, SIGMA, goal=torch.tensor([[goal], [1e9]]))
        picks = (design.picked >= 0).sum(1).tolist()
        assert 1 <= picks[0] <= 8
        assert picks[1] == 0
        assert bool((design.sigma[0, -1] <= goal).all())
        assert design.seconds[1] == 0
        assert not design.views.exists[1].any()
        assert torch.equal(design.covariance[1], found.covariance[1])

    def test_a_zoom_that_is_good_enough_gets_little(self, found, views):
        now = largest_sigma(found)
        goal = torch.stack([now[:, 0] * 2, now[:, 1] / 3], 1)
        design = choose(found, views, 8, SIGMA, goal=goal, costs=FREE)
        first, last = design.views.zooms
        assert (torch.maximum(first, last)[design.views.exists] == 1).double().mean() > 0.8

    def test_more_candidates_than_wanted_are_no_condition(self, found):
        few = candidates(found, anywhere(found), MARGIN, places=(2, 2), pairs=False)
        design = choose(found, few, 40, SIGMA)
        assert (design.picked >= 0).sum(1).tolist() == few.exists.sum(1).tolist()
        none = replace(few, mask=torch.zeros_like(few.mask))
        assert not choose(found, none, 3, SIGMA).views.exists.any()

    def test_the_sigma_that_calibrate_then_reports(self):
        """With the chosen views simulated, for one feature and for two."""
        for features in (1, 2):
            made = bodies(features, ray=np.array([[0.3, 0.1], [0.1, 0.4]])[:features])
            before = known(*map(seen, made))
            views = candidates(before, anywhere(before), MARGIN, places=(7, 5))
            design = choose(before, views, 16, SIGMA)
            more = [taken(design, camera) for camera in range(2)]
            after = known(*(seen(one, extra) for one, extra in zip(made, more, strict=True)))
            assert [len(extra[0]) for extra in more] == design.views.looks.sum(1).tolist()
            found = largest_sigma(after)
            assert (found / design.sigma[:, -1] - 1).abs().max() < 0.1
            assert (found < 0.9 * largest_sigma(before)).all()


class TestExhausted:
    def test_what_the_pupil_leaves_does_not_shrink(self):
        looks = [seen(one) for one in bodies()]
        told, untold = (
            known(*looks, priors=replace(PRIORS, pupil_sigma_m=sigma)) for sigma in (0.0005, 0.1)
        )
        least = []
        for c in (told, untold):
            views = candidates(c, anywhere(c), MARGIN)
            least.append(largest_sigma(c, covariance=exhausted(c, views, SIGMA, 100.0))[:, 0])
        assert (least[0] < 0.1).all()
        assert (least[1] > 0.3).all()
        assert (least[1] < largest_sigma(untold)[:, 0]).all()

    def test_as_from_scratch(self, found, views):
        rows = whitened(found, views, SIGMA).flatten(1, 2)
        wanted = scratch(found, rows * 3**0.5)
        size = wanted.diagonal(dim1=1, dim2=2).sqrt()
        scale = size[:, :, None] * size[:, None] + 1e-300
        assert ((exhausted(found, views, SIGMA, 3.0) - wanted).abs() / scale).max() < 1e-3


class TestCandidates:
    def test_on_the_grid_within_limits_and_inside_the_picture(self, found):
        quantum, origin = 0.004, 0.001
        middle = found.layout.split(found.theta)[2][:, 0, :2]
        reach = Reach(
            torch.full((2, 2), quantum, dtype=torch.float64),
            torch.full((2, 2), origin, dtype=torch.float64),
            middle - 0.2,
            middle + 0.3,
        )
        views = candidates(found, reach, torch.tensor([[10.0, 40.0]]))
        steps = (views.pose[views.exists] - origin) / quantum
        assert torch.allclose(steps, steps.round(), atol=1e-6)
        for camera in range(2):
            pose = views.pose[camera, views.exists[camera]]
            assert ((pose >= middle[camera] - 0.2) & (pose <= middle[camera] + 0.3)).all()
        margin = torch.tensor([10.0, 40.0])[views.zoom][views.mask][:, None]
        pixel = views.pixel[views.mask]
        assert (pixel >= margin).all()
        assert (pixel <= torch.tensor([735.0, 543.0]) - margin).all()
        # They are where the calibration says.
        problem, theta = problem_of(found, views)
        wanted = predict(problem, theta, derivatives=False).pixel.reshape(views.pixel.shape)
        assert torch.allclose(pixel, wanted[views.mask])
        first, last = views.zooms
        # At the wide end, not all can be reached.
        wide = views.exists & (first == 0) & (last == 0)
        assert 20 < wide.sum(1)[0] < 17 * 13

    @pytest.mark.parametrize("quantum", [0.0, 0.002])
    def test_features_are_brought_to_their_places(self, quantum):
        """Whatever is wrong with the head; to the rounding of its grid."""
        made = head_body.body(
            5,
            (1.0, 5.0),
            tilt_zero=0.01,
            boresight=0.01,
            roll=0.03,
            aspect=0.95,
            pupil=np.array([0.1, 0.2]),
        )
        priors = replace(PRIORS, pixel_aspect=0.95, pupil_m=torch.tensor([[0.1, 0.2]]))
        c = known(seen(made), priors=priors)
        reach = Reach.anywhere(torch.full((1, 2), quantum, dtype=torch.float64))
        views = candidates(c, reach, MARGIN, places=(4, 3), pairs=False)
        assert views.exists.all()
        pixel = views.pixel[0, :, 0].reshape(2, 4, 3, 2)
        focal = c.focal_length[0, :, None] * torch.tensor([1.0, 0.95])
        near = MARGIN + 0.6 * quantum * focal
        for zoom in range(2):
            x, y = (
                torch.linspace(float(low), side - 1 - float(low), n, dtype=torch.float64)
                for low, side, n in zip(near[zoom], (736, 544), (4, 3), strict=True)
            )
            off = (pixel[zoom] - torch.cartesian_prod(x, y).reshape(4, 3, 2)).abs().amax()
            assert off < 1e-6 + 0.8 * quantum * float(focal[zoom, 0])

    def test_a_shift_makes_others(self, found):
        plain, other = (
            candidates(found, anywhere(found), MARGIN, places=(5, 4), shift=shift, pairs=False)
            for shift in ((0.0, 0.0), (0.5, 0.5))
        )
        same = (plain.pose[0, :, None] == other.pose[0]).all(-1).any(-1)
        assert same.sum() <= 2 * 4  # corners, at both zooms

    def test_pairs_stand_where_the_longer_zoom_does(self, found, views):
        first, last = views.zooms
        pair = (first != last) & views.exists
        assert pair.sum(1).min() >= 8
        assert (first[pair] == 0).all()
        assert (last[pair] == 1).all()
        assert (views.looks[pair] == 2).all()
        alone = (first == 1) & (last == 1) & views.exists
        for camera in range(2):
            poses = {tuple(pose) for pose in views.pose[camera, alone[camera]].tolist()}
            assert {tuple(pose) for pose in views.pose[camera, pair[camera]].tolist()} <= poses

    def test_two_features_in_one_picture_are_both_looked_at(self, two):
        views = candidates(two, anywhere(two), MARGIN, pairs=False)
        first, _ = views.zooms
        both = views.looks == 2
        assert (both & (first == 0)).sum() > 50
        # Through the longer zoom they are too far apart; there the lens has no inverse, either.
        assert not (both & (first == 1)).any()
        assert set(views.feature[views.mask].tolist()) == {0, 1}

    def test_what_was_never_seen_is_no_candidate(self, found):
        unseen = replace(found, exists=found.exists & torch.tensor([[True, False], [True, True]]))
        views = candidates(unseen, anywhere(unseen), MARGIN, places=(4, 3))
        assert not (views.mask & (views.zoom == 1))[0].any()
        assert views.exists[0].any()
        assert (views.mask & (views.zoom == 1))[1].any()

    def test_a_feature_that_only_another_camera_has(self):
        plain = bodies()
        other = bodies(2, ray=np.array([[0.3, 0.1], [0.1, 0.4]]))
        c = known(seen(plain[0]), seen(other[1]))
        views = candidates(c, anywhere(c), MARGIN, places=(4, 3))
        assert not (views.mask & (views.feature == 1))[0].any()
        assert (views.mask & (views.feature == 1))[1].any()
        assert (choose(c, views, 3, SIGMA).picked >= 0).all()

    def test_beyond_the_limits_there_is_nothing(self):
        reach = anywhere([0, 1], 0.1)
        poses = torch.tensor([[[0.26, 0.0], [3.4, 0.0], [0.0, 1.6]]] * 2, dtype=torch.float64)
        got = reach.nearest(poses)
        assert torch.allclose(got[0, 0], torch.tensor([0.3, 0.0], dtype=torch.float64))
        # A pan is the same a turn later.
        assert got[0, 1, 0] == pytest.approx(-2.9)
        assert got[0, 2].isnan().all()


def some_views(poses, zooms, upwards=(0, 0), run_up=0.0):
    """Views of one camera with one feature, by hand; zooms: one or two of each."""
    pose = torch.tensor(poses, dtype=torch.float64)[None]
    zoom = torch.tensor([(z[0], z[-1]) for z in zooms])[None]
    mask = torch.tensor([(len(z) > 0, len(z) > 1) for z in zooms])[None]
    side = torch.tensor([upwards], dtype=torch.float64)
    pixel = torch.zeros(*zoom.shape, 2, dtype=torch.float64)
    return Views(
        pose,
        side,
        side[:, None] * run_up * torch.ones_like(pose),
        zoom,
        torch.zeros_like(zoom),
        pixel,
        mask,
    )


class TestRoute:
    def test_short_routes_are_nearly_the_shortest(self):
        rng = np.random.default_rng(1)
        costs = Costs(look_s=1.0, speed=0.5, zoom_s=2.0)
        worse = []
        for _ in range(20):
            poses = rng.uniform(-0.5, 0.5, (6, 2))
            zooms = [(int(z),) for z in rng.integers(0, 2, 6)]
            views = some_views(poses, zooms)
            start = Start(torch.zeros(1, 2, dtype=torch.float64), torch.tensor([0]))
            _, _, seconds = in_order(views, costs, start)
            best = min(
                self.walked(poses[list(p)], [zooms[i] for i in p], costs)
                for p in permutations(range(6))
            )
            worse.append(float(seconds) / best - 1)
            assert worse[-1] > -1e-9
        assert np.median(worse) < 0.01
        assert max(worse) < 0.15

    @staticmethod
    def walked(poses, zooms, costs):
        """Seconds of a way from (0, 0) at zoom 0."""
        total, here, zoom = 0.0, np.zeros(2), 0
        for pose, (own,) in zip(poses, zooms, strict=True):
            total += np.abs(pose - here).max() / costs.speed + costs.look_s
            total += costs.zoom_s * (own != zoom)
            here, zoom = pose, own
        return total

    def test_zoom_by_zoom(self):
        rng = np.random.default_rng(2)
        zooms = [(z,) for z in (0, 1, 2, 0, 1, 2, 0, 1, 2)]
        views = some_views(rng.uniform(-0.1, 0.1, (9, 2)), zooms)
        ordered, _, _ = in_order(views, Costs(zoom_s=5.0))
        assert int((ordered.zooms[0].diff() != 0).sum()) == 2

    def test_of_a_pair_the_look_at_the_present_zoom_comes_first(self):
        views = some_views([(0.0, 0.0), (0.01, 0.0), (0.02, 0.0)], [(0, 1), (0, 1), (0, 1)])
        start = Start(torch.zeros(1, 2, dtype=torch.float64), torch.tensor([1]))
        ordered, _, seconds = in_order(views, Costs(look_s=1.0, speed=1.0, zoom_s=2.0), start)
        assert ordered.zoom[0].flatten().tolist() == [1, 0, 0, 1, 1, 0]
        assert float(seconds) == pytest.approx(6 * 1.0 + 3 * 2.0 + 0.02)

    def test_views_that_are_none_come_last(self):
        views = some_views(
            [(0.3, 0.0), (0.0, 0.0), (0.1, 0.0), (0.2, 0.0)],
            [(0,), (), (0,), ()] and [(0,), (0,), (0,), (0,)],
        )
        views = replace(views, mask=views.mask & torch.tensor([[[True], [False], [True], [False]]]))
        ordered, _, seconds = in_order(views, Costs(look_s=1.0, speed=1.0))
        assert ordered.exists.tolist() == [[True, True, False, False]]
        assert float(seconds) == pytest.approx(2 + 0.2)

    def test_an_axis_with_play_is_only_moved_upwards(self):
        poses = [(0.0, 0.3), (0.1, 0.2), (0.2, 0.1)]
        views = some_views(poses, [(0,)] * 3, upwards=(0, 1), run_up=0.05)
        start = Start(torch.tensor([[0.0, 0.4]], dtype=torch.float64), torch.tensor([0]))
        ordered, via, seconds = in_order(views, Costs(look_s=1.0, speed=1.0), start)
        assert torch.equal(via[..., 0], ordered.pose[..., 0])
        before = torch.cat([start.pose[:, None], ordered.pose[:, :-1]], 1)
        come_from = torch.where((via != ordered.pose).any(-1, keepdim=True), via, before)
        assert (ordered.pose[..., 1] - come_from[..., 1] >= 0.05 - 1e-12).all()
        stops = int((via != ordered.pose).any(-1).sum())
        ways = [(before - via), (via - ordered.pose)]
        travel = sum(float(way.abs().amax(-1).sum()) for way in ways)
        assert float(seconds) == pytest.approx(3 + stops + travel)

    def test_travel_counts_zooms_once(self):
        views = some_views([(0.0, 0.0), (0.5, 0.0), (0.1, 0.0)], [(0,), (1,), (0, 1)])
        travel = Travel.begun(views, 2, Costs(look_s=1.0, speed=1.0, zoom_s=2.0), None)
        assert travel.price().tolist() == [[3.0, 3.0, 6.0]]
        travel = travel.after(torch.tensor([1]), torch.tensor([True]))
        assert travel.price().tolist() == [[pytest.approx(3.5), 1.0, pytest.approx(4.4)]]

    @pytest.mark.parametrize("wrong", [{"look_s": 0}, {"speed": -1.0}, {"zoom_s": -0.1}])
    def test_costs_that_are_none(self, wrong):
        with pytest.raises(ValueError, match="must be positive"):
            Costs(**wrong)
