"""The benchmark's section on chosen views: its camera, its even spreads, its figures and checks."""

from __future__ import annotations

import copy
import json
from dataclasses import replace

import numpy as np
import pytest

from torchptz.calibration.design import largest_sigma
from torchptz.observations import Observations


@pytest.fixture(scope="module")
def section(load):
    return load("head.views")


@pytest.fixture(scope="module")
def watched(load):
    return load("head.watched")


@pytest.fixture(scope="module")
def body(load):
    return load("head.body")


@pytest.fixture(scope="module")
def case(section, body):
    """A target that is soon reached."""
    return section.Case(body.FINE, "all", 0.8, 1)


@pytest.fixture(scope="module")
def chosen(section, case):
    """Calibration and figures of one camera's chosen views."""
    return section._chosen(case, 1)


@pytest.fixture(scope="module")
def result(section, case):
    """The section's quick run of that target."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(section, "QUICK_CASES", (case, replace(case, part="lines", target=0.3)))
        patch.setattr(section, "QUICK_LOOKS", 300)
        return section.run(quick=True)


class TestWatched:
    def test_it_sees_what_its_body_shows(self, watched, body):
        for head in (body.RZ30, body.FINE):
            camera = watched.Watched(3, head, 2)
            poses, zoom = camera.all("commanded"), camera.all("index")
            feature, pixel = camera.all("feature"), camera.all("pixel")
            quantum = np.array(head.quantum)
            assert np.abs(poses / quantum - np.rint(poses / quantum)).max() < 1e-6
            found = np.isfinite(pixel[:, 0])
            assert found.mean() > 0.95
            for one, own in enumerate(camera.bodies):
                there = found & (feature == one)
                away = pixel[there] - own.see(poses[there], zoom[there])
                # Jitter of 0.3 quanta and 0.1 px of noise, nothing else.
                focal = own.focal_length[zoom[there]]
                most = 0.15 * quantum.max() * focal * 2.5 + 0.5
                assert (np.abs(away).max(1) < most).all()

    def test_two_features_are_at_their_tilts(self, watched, body):
        camera = watched.Watched(0, body.FINE, 2)
        tilts = [np.degrees(one.direction[1]) for one in camera.bodies]
        assert tilts == pytest.approx([5.0, 40.0])
        assert all(one.distance == 12.0 for one in camera.bodies)
        assert (np.abs(camera.told / 12.0 - 1) < 0.25).all()
        assert camera.told[0] != camera.told[1]
        assert set(camera.all("feature").tolist()) == {0, 1}

    def test_looks_at_one_stop_share_its_error(self, watched, body):
        camera = watched.Watched(1, body.RZ30, 1)
        pose = body.RZ30.snapped(camera.bodies[0].direction + 0.001)[None]
        before = len(camera.all("index"))
        camera.look(np.repeat(pose, 2, 0), np.array([3, 2]), np.array([0, 0]))
        camera.look(pose + body.RZ30.quantum, np.array([3]), np.array([0]))
        camera.look(pose, np.array([3]), np.array([0]))
        first, wide, _, again = camera.all("pixel")[before:]
        own = camera.bodies[0]
        away = [
            (seen - own.see(pose, zoom)[0]) / own.focal_length[zoom]
            for seen, zoom in ((first, 3), (wide, 2), (again, 3))
        ]
        assert np.abs(away[0] - away[1]).max() < 5 * 0.14 / own.focal_length[2]
        assert np.abs(away[0] - away[2]).max() > 5 * 0.14 / own.focal_length[3]

    def test_stops_and_seconds_by_hand(self, watched, body):
        camera = watched.Watched(0, body.FINE, 1)
        camera._columns = []
        poses = np.array([(0.0, 0.0), (0.0, 0.0), (0.1, -0.3), (0.2, -0.3)])
        camera.look(poses, np.array([1, 0, 0, 0]), np.zeros(4, int))
        assert camera.views() == 3
        assert camera.seconds() == pytest.approx(4 * 1.0 + 0.3 + 0.1 + 2.0)
        here, zoom = camera.start()
        assert (tuple(here), zoom) == ((0.2, -0.3), 0)

    def test_its_looks_are_observations(self, watched, body):
        camera = watched.Watched(2, body.FINE, 2)
        o = Observations.from_lists([camera.looks()])
        assert o.zooms.tolist() == [[1.0, 2.0, 5.0, 12.0]]
        assert int(o.stop.max()) + 1 == camera.views()
        assert int(o.mask.sum()) == len(camera.all("index"))


class TestEven:
    @pytest.mark.parametrize("form", ["own share", "pairs"])
    def test_places_are_as_many_as_asked_and_all_over_the_picture(
        self, section, watched, body, chosen, form
    ):
        camera = watched.Watched(0, body.FINE, 1)
        before = len(camera.all("index"))
        section._spread(camera, form, np.array([40.0, 80.0, 160.0, 320.0]), chosen[0][0])
        index, pixel = camera.all("index")[before:], camera.all("pixel")[before:]
        if form == "own share":
            assert np.bincount(index) == pytest.approx([40, 80, 160, 320], rel=0.25)
        else:
            # Half of a zoom's looks are at the wider one.
            assert np.bincount(index) == pytest.approx([80, 120, 240, 160], rel=0.25)
        for zoom in range(4):
            own = pixel[(index == zoom) & np.isfinite(pixel[:, 0])]
            assert (own.min(0) < 35).all()
            assert (own.max(0) > np.array([735, 543]) - 35).all()

    def test_pairs_are_looks_from_one_stop(self, section, watched, body, chosen):
        camera = watched.Watched(0, body.FINE, 1)
        before = len(camera.all("index"))
        section._spread(camera, "pairs", np.array([4.0, 60.0, 60.0, 60.0]), chosen[0][0])
        index, poses = camera.all("index")[before:], camera.all("commanded")[before:]
        late = index[1:] - index[:-1] == 1
        same = (poses[1:] == poses[:-1]).all(1)
        assert (late & same).sum() >= 60

    def test_lines_are_the_collector_s(self, section, watched, body, chosen):
        camera = watched.Watched(0, body.FINE, 2)
        section._spread(camera, "lines", np.full(4, 480.0), chosen[0][0])
        looks = camera.looks()
        Observations.from_lists([looks])
        assert set(looks["feature"].tolist()) == {0, 1}
        own = np.bincount(camera.all("index"))
        assert own == pytest.approx(np.full(4, 480), rel=0.2)

    def test_what_is_needed_does_not_depend_on_where_the_search_began(self, section, case, chosen):
        """The root law: counts from a few looks and from more agree."""
        harder = replace(case, target=0.45)
        few, many = (section._even(harder, "own share", chosen[0], most) for most in (250, 1000))
        assert few["simulated"] < many["simulated"]
        assert few["looks"] == pytest.approx(many["looks"], rel=0.3)


class TestFigures:
    def test_the_target_is_reached_by_what_calibrate_says(self, section, case, chosen):
        found, figures = chosen
        assert figures["worst_px"] <= case.target
        assert figures["worst_px"] == pytest.approx(float(largest_sigma(found[0]).max()))
        assert figures["looks"] == figures["simulated"]
        assert figures["views"] <= figures["looks"]

    def test_errors_over_sigmas(self, section, watched, case, chosen):
        found = chosen[0][0]
        camera = watched.Watched(0, case.head, case.features)
        for part in ("all", "lines"):
            own = replace(case, part=part)
            once = section._errors(found, camera, own)
            twice = section._errors(replace(found, covariance=4 * found.covariance), camera, own)
            assert once.shape == (4,)
            assert twice == pytest.approx(once / 2, rel=1e-6)
            assert (once > 0.05).all()
            assert (once < 4).all()

    def test_figures_are_plain_and_the_table_has_them(self, section, result):
        json.dumps(result, allow_nan=False)
        table = section.table(result)
        assert table.count("| fine |") == 2 * 4
        assert result["cases"][0]["chosen"]["error"] > 0

    def test_checks(self, section, result):
        found = section.checks(result)
        assert len(found) == 2 * (2 + 2 * 3)
        assert all(isinstance(one, bool) for one in found.values())

    @pytest.mark.parametrize(
        ("path", "value", "broken"),
        [
            (("chosen", "worst_px"), 1.0, "every camera"),
            (("chosen", "error"), 2.0, "errors are"),
            (("chosen", "error"), 0.2, "errors are"),
            (("lines", "views"), 1.0, "2 times fewer views than lines"),
            (("own share", "minutes"), 0.1, "2 times fewer minutes than own share"),
            (("pairs", "views"), 1.0, "1 times fewer views than pairs"),
        ],
    )
    def test_checks_can_fail(self, section, result, path, value, broken):
        wrong = copy.deepcopy(result)
        wrong["cases"][0][path[0]][path[1]] = value
        failed = {name for name, ok in section.checks(wrong).items() if not ok}
        new = failed - {name for name, ok in section.checks(result).items() if not ok}
        assert any(broken in name for name in new | failed)
        assert all(broken in name for name in new)
