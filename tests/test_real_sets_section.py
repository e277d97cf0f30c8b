"""The benchmark's section on real line sets: its measure, its peers, its checks."""

from __future__ import annotations

import copy
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import minimize

from tests import synthetic

LENS = synthetic.lens((0.02, 0.08, 0.0), powers=(1, 2, 3))
TRUTH = synthetic.truth_of(LENS)


@pytest.fixture(scope="module")
def line_sets(load):
    return load("accuracy.line_sets")


@pytest.fixture(scope="module")
def peers(load):
    return load("accuracy.peers")


@pytest.fixture(scope="module")
def section(load):
    return load("accuracy.real_sets")


@pytest.fixture(scope="module")
def chords(line_sets):
    """Lines seen through LENS with 0.2 px of noise."""
    noise = np.random.default_rng(0)
    lines = [one + noise.normal(0, 0.2, one.shape) for one in synthetic.chords(TRUTH, points=15)]
    count = len(lines)
    return line_sets.LineSet(
        "chords", synthetic.PAPER_SIZE, lines, np.zeros(count, int), np.full(count, 2), []
    )


@pytest.fixture(scope="module")
def boards(line_sets):
    """Six tilted boards of 8x6 corners, and their rows and columns."""
    camera = np.array([[600.0, 0, 324.0], [0, 600.0, 236.0], [0, 0, 1]])
    flat = np.stack([*np.meshgrid(np.arange(8.0), np.arange(6.0)), np.zeros((6, 8))], -1)
    found = []
    for tilt in ((0.2, 0.1), (-0.3, 0.0), (0.0, 0.3), (0.3, -0.2), (-0.1, -0.3), (0.1, 0.35)):
        turned, _ = cv2.Rodrigues(np.array([*tilt, 0.02]))
        corners = (flat.reshape(-1, 3) - [3.5, 2.5, 0]) @ turned.T + [0.2, -0.1, 9.0]
        away = corners[:, :2] / corners[:, 2:]
        away = away * (1 - 0.25 * (away**2).sum(1, keepdims=True))
        found.append((away @ camera[:2, :2].T + camera[:2, 2]).reshape(6, 8, 2))
    lines = [line for board in found for line in (*board, *board.transpose(1, 0, 2))]
    kind = np.tile([0] * 6 + [1] * 8, len(found))
    image = np.repeat(np.arange(len(found)), 14)
    return line_sets.LineSet("boards", synthetic.PAPER_SIZE, lines, image, kind, found)


class TestMeasure:
    def test_no_other_line_is_straighter(self, line_sets, chords):
        """Bent and unevenly stretched, so that the best line is not the total least squares one."""

        def undistort(points):
            return points * (1 + points[:, :1] / 500) + 1e-4 * points[:, ::-1] ** 2

        line = chords.lines[0]
        (got,) = line_sets.residuals([line], undistort)
        x, y = line.T
        corrected = undistort(line)
        by_x = np.stack([1 + x / 250, y / 500 + 2e-4 * x], -1)
        by_y = np.stack([2e-4 * y, 1 + x / 500], -1)

        def cost(at):
            normal = np.array([np.cos(at[0]), np.sin(at[0])])
            size = np.hypot(by_x @ normal, by_y @ normal)
            return ((((corrected - corrected.mean(0)) @ normal + at[1]) / size) ** 2).sum()

        best = min(
            minimize(
                cost, [angle, 0.0], method="Nelder-Mead", tol=1e-12, options={"maxiter": 4000}
            ).fun
            for angle in np.linspace(0, np.pi, 8)
        )
        assert (got**2).sum() == pytest.approx(best, rel=1e-6)

    def test_shrinking_the_picture_gains_nothing(self, line_sets, chords):
        full = line_sets.residuals(chords.lines, TRUTH.undistort)
        small = line_sets.residuals(chords.lines, lambda p: 0.1 * TRUTH.undistort(p) + 5)
        assert line_sets.rms(small) == pytest.approx(line_sets.rms(full), rel=1e-7)

    def test_it_is_the_noise_across_the_lines(self, line_sets, chords):
        left = line_sets.rms(line_sets.residuals(chords.lines, TRUTH.undistort))
        assert left == pytest.approx(0.2 * np.sqrt(13 / 15), rel=0.15)

    def test_a_point_outside_of_the_lens_makes_its_line_infinite(self, line_sets, chords):
        x = chords.lines[2][0, 0]

        def undistort(points):
            return np.where(np.abs(points[:, :1] - x) < 0.01, np.nan, points)

        left = line_sets.residuals(chords.lines, undistort)
        assert [bool(np.isinf(line).all()) for line in left].index(True) == 2
        assert np.isfinite(np.concatenate(left[:2] + left[3:])).all()

    def test_halves_share_no_line_and_leave_none_out(self, chords, boards):
        for whole in (chords, boards):
            parts = [line.tobytes() for half in (0, 1) for line in whole.half(half).lines]
            assert sorted(parts) == sorted(line.tobytes() for line in whole.lines)
        assert set(boards.half(1).image) == {1, 3, 5}


class TestPeers:
    def test_scipy_finds_the_lens(self, peers, chords):
        clean = replace(chords, lines=synthetic.chords(TRUTH))
        fit = peers.fit_scipy(clean, (1, 2, 3), starts=1)
        assert fit.converged
        assert fit.center == pytest.approx(LENS.center[0].tolist(), abs=1e-4)

    def test_its_gradient_is_that_of_the_refitted_lines(self, peers, chords):
        problem = peers._Straightness(chords, (1, 2, 3))
        theta = np.array([310.0, 250.0, 0.05, 0.05, 0.01])
        gradient = problem.jacobian(theta).T @ problem.residual(theta)
        for i, step in enumerate([1e-3, 1e-3, 1e-5, 1e-5, 1e-5]):
            up, down = (
                (problem.residual(theta + sign * step * np.eye(5)[i]) ** 2).sum() / 2
                for sign in (1, -1)
            )
            assert gradient[i] == pytest.approx((up - down) / (2 * step), rel=1e-5)

    @pytest.mark.parametrize("program", ["fit_opencv", "fit_discorpy"])
    def test_board_programs_straighten_boards(self, line_sets, peers, boards, program):
        before = line_sets.rms(line_sets.residuals(boards.lines, lambda points: points))
        fit = getattr(peers, program)(boards)
        after = line_sets.rms(line_sets.residuals(boards.lines, fit.undistort))
        assert after < (0.01 if program == "fit_opencv" else 0.3) * before
        # Half of a single board has every second row, twice as far apart.
        one = boards.half(0).half(0).half(0)
        assert len(one.boards) == 1
        assert one.half(1).row_step == 2

    def test_without_boards_there_is_no_board_program(self, peers, chords):
        assert peers.fit_opencv(chords) is None
        assert peers.fit_discorpy(chords) is None


class TestSection:
    def test_without_data_it_says_so_and_promises_nothing(self, section, monkeypatch, tmp_path):
        monkeypatch.setattr(section, "DATA", tmp_path)
        result = section.run(quick=True)
        assert section.checks(result) == {}
        assert "not there" in section.table(result)

    def test_checks_fail_where_the_figures_do(self, section, quick):
        assert all(section.checks(quick).values())
        for change in ({"rms_px": 0.5}, {"from_scipy_px": 0.31}):
            worse = copy.deepcopy(quick)
            for program in ("ml {1, 2, 3}", "ml auto"):
                worse["sets"]["discorpy_laptop"]["programs"][program] |= change
            assert not all(section.checks(worse).values())
        worse = copy.deepcopy(quick)
        auto = worse["sets"]["discorpy_laptop"]["programs"]["ml auto"]
        auto["excess"] = 2.1 * auto["excess_sigma"] + 1e-9
        assert [name for name, holds in section.checks(worse).items() if not holds] == [
            "discorpy_laptop: auto's held-out residual no worse than {1, 2, 3}'s"
        ]

    def test_figures_are_plain_and_in_the_table(self, section, quick):
        json.dumps(quick, allow_nan=False)
        table = section.table(quick)
        assert "| | opencv |" in table
        assert "| | discorpy |" in table
        assert "pjlab_harp" in table


@pytest.fixture(scope="module")
def quick(section):
    """The section's quick run."""
    if not section.DATA.is_dir():
        pytest.skip(f"the real data sets are not there ({section.DATA})")
    return section.run(quick=True)
