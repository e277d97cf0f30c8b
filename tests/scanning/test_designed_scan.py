"""Chosen views: taken as they were planned, and a collection that chooses them to its end."""

import math
import threading
from collections import Counter
from dataclasses import replace
from itertools import chain, pairwise

import numpy as np
import pytest
import torch

from tests import synthetic
from tests.fake_camera import QUANTUM, FakeCamera, FakeObserver, capabilities
from torchptz.calibration import Priors, calibrate
from torchptz.calibration.candidates import Reach, candidates
from torchptz.calibration.design import choose
from torchptz.calibration.route import Costs
from torchptz.fleet import collector
from torchptz.fleet import designed as designed_collection
from torchptz.fleet.collector import Collector
from torchptz.fleet.config import parse_config
from torchptz.fleet.journal import JOURNAL_NAME, read_journal
from torchptz.fleet.probe_report import ProbeReport
from torchptz.fleet.solve import solve
from torchptz.geometry import ray_from_pan_tilt
from torchptz.observations import Observations
from torchptz.scanning.designed_scan import ViewScan, expected_at
from torchptz.scanning.line_scan import FeatureLost, View, plan_lines, scan_pattern
from torchptz.scanning.prediction import ImagePredictor
from torchptz.simulation import CameraTruth, SimulatedFleet

SIZE, POINT, FOCAL = (736, 544), np.array([371.0, 268.5]), 720.0
RAY = ray_from_pan_tilt(*synthetic.double(0.2, 0.4))
LENS = synthetic.lens((0.01, 0.06, 0.01), (374.0, 266.0), SIZE)
ZOOMS = (1.0, 4.0)
LIMITS = {"pan_limits": (-2.9, 2.9), "tilt_limits": (-0.5, 1.5)}
UPWARDS = torch.zeros(1, 2, dtype=torch.float64)


def camera_of(**changed):
    return FakeCamera(RAY, LENS, POINT, FOCAL, **changed)


def views_of(camera):
    """What a collector believes of each zoom."""
    return [
        View(SIZE, POINT + 1.0, FOCAL * zoom * 1.01, 1.0, camera.zoom_units(zoom), radius=8.0)
        for zoom in ZOOMS
    ]


def calibrated(observer):
    """From all that an observer saw."""
    looks = observer.looks
    poses = np.array([(look.commanded.pan, look.commanded.tilt) for look in looks])
    found = [look.found for look in looks]
    seen = {
        "camera": "fake",
        "image_size": SIZE,
        "quantum": QUANTUM,
        "zoom": [observer.camera.magnification(look.commanded.zoom) for look in looks],
        "commanded": poses,
        "read": [(look.read_before.pan, look.read_before.tilt) for look in looks],
        "pixel": [look.pixel or (math.nan, math.nan) for look in looks],
        "sigma": np.where(found, 0.05, math.nan),
    }
    seen["zoom"] = np.round(seen["zoom"], 6)
    return calibrate(Observations.from_lists([seen]), Priors(distance_m=1e4, pupil_sigma_m=1e-4))


@pytest.fixture(scope="module")
def begun():
    """An observer that has seen some of both zooms, and the calibration from it."""
    observer = FakeObserver(camera_of(), noise=0.05)
    for index, view in enumerate(views_of(observer.camera)):
        plan = plan_lines(view, RAY, capabilities(), 3, 3, 0, 6, 0.9)
        list(scan_pattern(observer, view, RAY, plan, ImagePredictor(SIZE, POINT), index))
    return observer, calibrated(observer)


def observer_after(begun, **how):
    """A new observer of the same camera."""
    return FakeObserver(camera_of(), **how), begun[1]


def designed(calibration, count=6, upwards=None):
    can = capabilities()
    pairs = (
        QUANTUM,
        (can.pan_origin, can.tilt_origin),
        *zip(can.pan_limits, can.tilt_limits, strict=True),
    )
    reach = Reach(*(torch.tensor([pair], dtype=torch.float64) for pair in pairs))
    views = candidates(calibration, reach, 20.0)
    if upwards is not None:
        run_up = torch.tensor(upwards, dtype=torch.float64) * 3 * torch.tensor(QUANTUM)
        views = replace(
            views,
            upwards=torch.tensor([upwards], dtype=torch.float64),
            run_up=run_up.expand_as(views.pose),
        )
    return choose(calibration, views, count, 0.05, costs=Costs())


class TestTake:
    def test_looks_are_the_design_s_in_its_order(self, begun):
        observer, calibration = observer_after(begun, noise=0.05)
        design = designed(calibration)
        scan = ViewScan(observer, views_of(observer.camera))
        looks = list(scan.take(design, calibration, [0, 1]))
        assert looks == observer.looks
        stop, look = design.views.mask[0].nonzero().unbind(1)
        assert len(looks) == len(stop) >= 6
        for one, pose, zoom in zip(
            looks, design.views.pose[0, stop], design.views.zoom[0, stop, look], strict=True
        ):
            assert (one.purpose, one.zoom_index, one.group) == ("view", int(zoom), 1)
            assert (one.commanded.pan, one.commanded.tilt) == tuple(pose.tolist())
            assert one.commanded.zoom == observer.camera.zoom_units(ZOOMS[int(zoom)])
            at = observer.camera.capabilities.nearest_reachable(*pose.tolist())
            assert at == pytest.approx(tuple(pose.tolist()), abs=1e-9)
        assert all(one.found for one in looks)
        assert {one.zoom_index for one in looks} == {0, 1}
        assert next(scan.take(design, calibration, [0, 1])).group == 2

    def test_levels_say_which_view_a_zoom_is(self, begun):
        observer, calibration = observer_after(begun)
        views = views_of(observer.camera)
        looks = list(
            ViewScan(observer, views[::-1]).take(designed(calibration), calibration, [1, 0])
        )
        for look in looks:
            assert look.commanded.zoom == views[1 - look.zoom_index].zoom

    def test_the_feature_is_expected_where_the_reading_says(self, begun):
        """Also beside the target; and it is looked for no farther than needed."""
        slips = np.random.default_rng(3).uniform(-2, 2, (99, 2)) * QUANTUM
        observer, calibration = observer_after(begun, slip=lambda number: tuple(slips[number]))
        looks = list(
            ViewScan(observer, views_of(observer.camera)).take(
                designed(calibration), calibration, [0, 1]
            )
        )
        away = [
            np.linalg.norm(near - observer.camera.ball(look.read_before))
            for look, (near, _) in zip(looks, observer.searches, strict=True)
        ]
        assert max(away) < 1.5
        radii = np.array([radius for _, radius in observer.searches])
        assert (radii >= 6).all()
        assert (radii < 30).all()

    def test_where_the_lens_is_hardly_known_the_search_is_wider(self, begun):
        _, calibration = begun
        vague = replace(calibration, covariance=1e4 * calibration.covariance)
        observer, design = FakeObserver(camera_of()), designed(calibration)
        list(ViewScan(observer, views_of(observer.camera)).take(design, vague, [0, 1]))
        assert max(radius for _, radius in observer.searches) > 12
        assert max(radius for _, radius in observer.searches) <= 184

    def test_a_stop_on_the_way_is_looked_at(self, begun):
        observer, calibration = observer_after(begun)
        design = designed(calibration, upwards=(1.0, 1.0))
        stops = (design.via != design.views.pose).any(-1) & design.views.exists
        assert stops.any()
        looks = list(
            ViewScan(observer, views_of(observer.camera)).take(design, calibration, [0, 1])
        )
        assert len(looks) == int(design.views.looks.sum()) + int(stops.sum())
        poses = np.array([(look.commanded.pan, look.commanded.tilt) for look in looks])
        wanted = {tuple(pose) for pose in design.views.pose[0].tolist()}
        for before, pose in pairwise(poses):
            if tuple(pose) in wanted:
                assert (pose >= before - 1e-12).all()

    def test_what_is_expected_is_seen_within_its_sigma(self, begun):
        observer, calibration = begun
        rng = np.random.default_rng(4)
        errors = []
        for _ in range(40):
            zoom = int(rng.integers(2))
            view = views_of(observer.camera)[zoom]
            near = 0.3 / ZOOMS[zoom]
            pose = torch.tensor([0.2, 0.4]) + torch.from_numpy(rng.uniform(-near, near, 2))
            at = replace(
                observer.camera.pose, pan=float(pose[0]), tilt=float(pose[1]), zoom=view.zoom
            )
            place, sigma = expected_at(calibration, pose, zoom, 0, UPWARDS)
            errors.append(np.abs(place.numpy() - observer.camera.ball(at)).max() / sigma)
        assert np.sqrt(np.mean(np.square(errors))) < 3
        assert max(errors) < 6  # the radius of the search

    def test_a_feature_that_is_gone(self, begun):
        """Counted over batches; what lies outside the picture is not missed."""
        observer, calibration = observer_after(begun, blind=lambda number: number != 14)
        scan = ViewScan(observer, views_of(observer.camera))
        design = designed(calibration, count=8)
        batches = chain.from_iterable(scan.take(design, calibration, [0, 1]) for _ in range(20))
        with pytest.raises(FeatureLost, match=r"camera fake: .* 20 times in a row"):
            list(batches)
        expected = len(observer.looks) - 15
        assert 20 <= expected <= 60

    def test_near_the_border_nothing_is_missed(self, begun):
        observer, calibration = observer_after(begun, blind=lambda number: True)
        # Features that nearly fill the picture: all places are next to its border.
        views = [replace(view, radius=250.0) for view in views_of(observer.camera)]
        design = designed(calibration, count=30)
        looks = list(ViewScan(observer, views).take(design, calibration, [0, 1]))
        assert len(looks) >= 30


def in_memory(monkeypatch, tmp_path, camera=None, head=None, noise=0.05, zooms=ZOOMS, **scan):
    """A collection of a camera in memory; its record, what was told, and its folder."""
    camera = camera or camera_of(capabilities=capabilities(horizontal_fov=math.radians(54)))
    config = parse_config(
        {
            "cameras": [
                {
                    **{"name": "gate", "address": "gate", "dialect": "sony_rz30"},
                    "zooms": [*zooms],
                    "feature": {"distance_m": 12},
                    "head": {"pupil_sigma_m": 0.001, **(head or {})},
                    "scan": {"tracks": 4, "design": "optimal", **scan},
                }
            ]
        }
    )
    monkeypatch.setattr(collector, "open_camera", lambda *_, **__: camera)
    monkeypatch.setattr(collector, "probe", lambda *_, **__: ProbeReport("fake"))
    monkeypatch.setattr(
        collector,
        "Observer",
        lambda camera, record, *_: FakeObserver(camera, 8.0, noise=noise, record=record),
    )
    told = []
    folder = tmp_path / "run" / "gate"
    record = Collector(
        config.cameras[0], folder, threading.Event(), lambda *what: told.append(what)
    ).run()
    return record, told, folder


class TestCollection:
    def test_it_ends_when_every_zoom_is_known_well_enough(self, monkeypatch, tmp_path):
        record, told, folder = in_memory(monkeypatch, tmp_path, target_sigma_px=0.3)
        assert record.error is None
        assert record.finished
        assert record.views_ended == "every zoom is known to 0.3 px"
        sigma = [zoom.sigma_px for zoom in record.zooms]
        assert all(0.1 < one <= 0.3 for one in sigma)
        looks = list(read_journal(folder / JOURNAL_NAME))
        views = [look for look in looks if look.purpose == "view"]
        assert {look.zoom_index for look in views} == {0, 1}
        assert all(zoom.points > 15 for zoom in record.zooms)
        assert sum(zoom.points for zoom in record.zooms) == sum(
            look.found for look in looks if look.purpose in ("view", "line")
        )
        # What solves it afterwards finds the same, and the truth is within it.
        summary = solve(folder.parent)
        zooms = summary.cameras["gate"].zooms
        assert [zoom.sigma_px for zoom in zooms] == pytest.approx(sigma, rel=1e-6)
        assert all(zoom.ok for zoom in zooms)
        steps = [what for _, what, _, _ in told if what.startswith("choosing views")]
        assert len(steps) > 2
        assert all(done <= total == 800 for _, what, done, total in told if what in steps)

    def test_it_ends_where_no_more_views_are_wanted(self, monkeypatch, tmp_path):
        record, _, folder = in_memory(
            monkeypatch, tmp_path, target_sigma_px=0.01, most_views=30, noise=0.3
        )
        assert record.error is None
        assert record.views_ended.startswith("most_views (30 at a zoom) were taken: ")
        looks = Counter(
            look.zoom_index
            for look in read_journal(folder / JOURNAL_NAME)
            if look.purpose in ("view", "line")
        )
        assert all(30 <= looks[zoom] <= 30 + 2 * 12 for zoom in (0, 1))
        assert all(zoom.sigma_px > 0.01 for zoom in record.zooms)

    def test_what_the_entrance_pupil_leaves_ends_it_with_that_reason(self, monkeypatch, tmp_path):
        record, _, _ = in_memory(
            monkeypatch,
            tmp_path,
            head={"pupil_sigma_m": 0.3},
            zooms=ZOOMS[:1],
            target_sigma_px=0.3,
        )
        assert record.error is None
        assert record.views_ended.startswith("views cannot tell more: ")
        assert "px at 1x" in record.views_ended
        assert "entrance pupil" in record.views_ended
        assert record.zooms[0].sigma_px > 0.3

    def test_a_zoom_that_gains_nothing_does_not_hold_up_the_others(self, monkeypatch, tmp_path):
        """Nothing: here, less than nine tenths in as many batches as it gets."""
        monkeypatch.setattr(designed_collection, "_GAIN", 0.9)
        monkeypatch.setattr(designed_collection, "_PATIENCE", 1)
        record, _, folder = in_memory(monkeypatch, tmp_path, target_sigma_px=0.05)
        assert record.error is None
        assert record.views_ended.startswith("views cannot tell more: ")
        views = [one for one in read_journal(folder / JOURNAL_NAME) if one.purpose == "view"]
        assert 2 * 12 <= len(views) < 200

    def test_where_no_view_would_help_it_ends(self, monkeypatch, tmp_path):
        """Of a calibration that knows nothing, not even a sigma."""
        plain = designed_collection.calibrate

        def lost(*given):
            found = plain(*given)
            return replace(found, covariance=torch.full_like(found.covariance, torch.nan))

        monkeypatch.setattr(designed_collection, "calibrate", lost)
        record, _, _ = in_memory(monkeypatch, tmp_path, target_sigma_px=0.3)
        assert record.error is None
        assert record.views_ended.startswith("no view within reach would tell more: inf px at ")
        assert all(zoom.sigma_px is None for zoom in record.zooms)

    def test_a_zoom_at_which_nothing_is_found_does_not_stop_the_others(self, monkeypatch, tmp_path):
        camera = camera_of(capabilities=capabilities(horizontal_fov=math.radians(54)))
        plain, hidden = camera.ball, camera.zoom_units(ZOOMS[1])
        camera.ball = lambda pose: (
            np.full(2, -99.0) if math.isclose(pose.zoom, hidden) else plain(pose)
        )
        record, _, _ = in_memory(monkeypatch, tmp_path, camera, target_sigma_px=1.0)
        assert record.error is None
        assert record.zooms[1].error == "the feature was not found at this zoom"
        assert record.zooms[1].sigma_px is None
        assert record.zooms[0].sigma_px <= 1.0
        assert record.views_ended == "every zoom is known to 1 px"


@pytest.fixture
def simulated(tmp_path):
    """A simulated camera behind a real socket, and its configuration."""
    (tmp_path / "password").write_text("hush")
    one = {
        **{"name": "gate", "seed": 21, "password": "hush", "image_size": (368, 272)},
        "scene": {
            "board": None,
            "ball": {"pan_deg": 20.0, "tilt_deg": 6.0, "distance_m": 12.0, "radius_m": 0.072},
        },
        "head": {"speed_up": 500.0, "reading_jitter": 0.3, "boresight_deg": (0.2, 0.1)},
    }
    with SimulatedFleet({"cameras": [one]}) as fleet:
        config = parse_config(
            {
                "cameras": [
                    {
                        **{"name": "gate", "dialect": "sony_rz30"},
                        "address": fleet.addresses["gate"],
                        "credentials": {"user": "admin", "password_file": "password"},
                        "feature": {"pan_deg": 18.0, "tilt_deg": 8.0, "distance_m": 12.0},
                        "zooms": [1.0, 6.0],
                        "head": {"pupil_sigma_m": 0.002},
                        "scan": {"tracks": 4, "design": "optimal", "target_sigma_px": 1.0},
                        "timing": {
                            "settle_timeout_s": 5.0,
                            "poll_interval_s": 0.002,
                            "settle_s": 0.005,
                        },
                    }
                ]
            },
            folder=tmp_path,
        )
        yield fleet.cameras["gate"], config.cameras[0], tmp_path / "run" / "gate"


class TestSimulated:
    def test_the_lens_is_as_true_as_it_is_said_to_be(self, simulated):
        camera, config, folder = simulated
        record = Collector(config, folder, threading.Event()).run()
        assert record.error is None
        assert record.views_ended == "every zoom is known to 1 px"
        assert any(look.purpose == "view" for look in read_journal(folder / JOURNAL_NAME))
        truth = CameraTruth.of(camera)
        for zoom, result in zip(
            record.zooms, solve(folder.parent).cameras["gate"].zooms, strict=True
        ):
            assert result.ok
            off = abs(result.focal_length_px - truth.focal_length(zoom.zoom_units))
            assert off < 4 * result.focal_length_sigma_px

    def test_it_can_be_stopped(self, simulated):
        _, config, folder = simulated
        stop = threading.Event()

        def progress(name, what, done, total):
            if what.startswith("choosing"):
                stop.set()

        record = Collector(config, folder, stop, progress).run()
        assert "stopped before it was finished" in record.error
        assert not record.finished
        assert all(zoom.sigma_px is not None for zoom in record.zooms)
        assert sum(look.purpose == "line" for look in read_journal(folder / JOURNAL_NAME)) > 15
