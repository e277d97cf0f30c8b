"""The paper's experiment on a Sony SNC-RZ30P, here a simulated one behind real HTTP."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from demo_check import undistortion
from simulated_pictures import draw_collected, photograph_board

from paper.device import Settings, fleet, simulation
from torchptz.cameras import CameraError
from torchptz.estimation import Fit, estimate
from torchptz.estimation.fixed_point import iterate, line_variances
from torchptz.estimation.problem import Problem
from torchptz.fleet.driver import collect
from torchptz.fleet.photographs import find_corners
from torchptz.fleet.records import CameraRecord, ZoomRecord
from torchptz.lens import RadialLens
from torchptz.patterns import LinePatterns
from torchptz.rectification import rectify
from torchptz.report.figures import draw_before_after, save_figure
from torchptz.simulation import (
    CameraTruth,
    SimulationConfig,
    compare_lens,
    load_truth,
    serve_in_process,
)

POWERS = (1, 2, 3)
Say = Callable[[str], None]


def run(settings: Settings, out: Path, say: Say) -> dict:
    """The experiment; draws figures 1 and 3 into ``out``, where what is collected is kept too.

    Returns:
        Figures measured, as plain data for JSON.

    Raises:
        RuntimeError: the simulation or the camera failed; says why.
    """
    started = time.perf_counter()
    simulated = simulation()
    name = simulated.cameras[0].name
    out.mkdir(parents=True, exist_ok=True)
    # The truth lies beside the run: what is in the run, an estimator may read.
    run_folder, truth_path = out / "run", out / "truth.json"
    with serve_in_process(simulated, truth_path) as addresses:
        config = fleet(simulated, addresses, settings)
        record = collect(config, run_folder, _stages(say))[name]
        if record.error is not None:
            raise CameraError(record.error)
        zoom = record.zooms[0]
        if zoom.patterns is None:
            raise CameraError(f"camera {name}: {zoom.error}")
        say("camera: pointing it at the checkerboard")
        picture = photograph_board(config.cameras[0], simulated)
    collected = time.perf_counter() - started
    truth = load_truth(truth_path)[name]
    say("camera: estimating")
    patterns = LinePatterns.load(run_folder / name / zoom.patterns)
    without = patterns.without_offsets()
    start = torch.tensor([record.principal_point], dtype=torch.float64)
    fits = {
        "with_offsets": estimate(patterns, POWERS, center=start),
        # The head's rounding is no outlier, and looks like it.
        "without_offsets": estimate(without, POWERS, robust=False, center=start),
    }
    result = {
        "simulation_seed": simulated.cameras[0].seed,
        "image_size": list(record.image_size),
        "lines": zoom.lines,
        "points": zoom.points,
        "principal_point": _principal_point(record, truth),
        "focal_length_px": zoom.focal_length_px,
        "focal_length_true_px": truth.focal_length(zoom.zoom_units),
        "center_true_px": truth.centre(zoom.zoom_units).tolist(),
        "paper_loop": _paper_loop(without, start, truth, zoom),
        **{
            key: _judge(fit, patterns if fit.gain is not None else without, start, truth, zoom)
            for key, fit in fits.items()
        },
    }
    say("camera: drawing figures 1 and 3")
    lens = fits["with_offsets"].lens
    rectified = rectify(picture, lens)
    save_figure(draw_collected(run_folder / name), out / "figure1_patterns.png")
    result["board"] = _draw_board((picture, rectified), simulated, out)
    result["seconds_collecting"] = collected
    result["seconds"] = time.perf_counter() - started
    return result


def _stages(say: Say) -> Callable[[str, str, int, int], None]:
    last: list[tuple[str, int]] = []

    def progress(camera: str, what: str, done: int, total: int) -> None:
        stage = (what, done * 4 // max(total, 1))
        if not last or last[-1] != stage:
            last.append(stage)
            say(f"camera {camera}: {what}" + (f" ({done} of {total})" if total > 1 else ""))

    return progress


def _principal_point(record: CameraRecord, truth: CameraTruth) -> dict:
    point = np.asarray(record.principal_point)
    covariance = np.asarray(record.principal_point_covariance)
    return {
        "estimated_px": point.tolist(),
        "sigma_px": np.sqrt(np.diag(covariance)).tolist(),
        "error_px": float(np.linalg.norm(point - truth.principal_point(0.0))),
    }


def _paper_loop(
    patterns: LinePatterns, start: torch.Tensor, truth: CameraTruth, zoom: ZoomRecord
) -> dict:
    """The two-step iteration as published: no offsets, every point the same weight."""
    problem = _unweighted(patterns)
    loop = iterate(
        problem, start, tolerance_l=1e-9, tolerance_center=1e-6, max_iterations=300, record=True
    )
    count = problem.weight.sum(-1)
    mean = torch.stack([(one * count).nansum() / count.sum() for one in loop.history])
    lens = RadialLens(loop.center, loop.coefficients, POWERS, None, problem.image_size)
    return {
        "variance_before_px2": float(mean[0]),
        "variance_after_px2": float(mean[-1]),
        "iterations_to_floor": int((mean <= 1.01 * mean[-1]).double().argmax()),
        "iterations_to_stop": int(loop.iterations[0]),
        "converged": bool(loop.converged[0]),
        "center_shift_px": float(torch.linalg.vector_norm(loop.center - start)),
        "coefficients": loop.coefficients[0].tolist(),
        **_errors(lens, truth, zoom),
    }


def _judge(fit: Fit, patterns: LinePatterns, start: torch.Tensor, truth: CameraTruth, zoom) -> dict:
    """What an estimate says of itself, and what the truth says of it."""
    problem = _unweighted(patterns)
    nothing = torch.zeros_like(fit.lens.coefficients)
    before = line_variances(problem, problem.correct(start, nothing))
    after = line_variances(
        problem, problem.correct(fit.lens.center, fit.lens.coefficients, fit.gain)
    )
    center = fit.lens.center[0]
    return {
        "status": fit.status[0].name,
        "variance_before_px2": float(before.nanmean()),
        "variance_after_px2": float(after.nanmean()),
        "rms_px": float(fit.rms_px[0]),
        "iterations": int(fit.iterations[0]),
        "center_px": center.tolist(),
        "center_shift_px": float(torch.linalg.vector_norm(center - start[0])),
        "coefficients": fit.lens.coefficients[0].tolist(),
        "gain": None if fit.gain is None else float(fit.gain[0]),
        "gain_sigma": None if fit.gain_sigma is None else float(fit.gain_sigma[0]),
        **_errors(fit.lens, truth, zoom),
    }


def _errors(lens: RadialLens, truth: CameraTruth, zoom: ZoomRecord) -> dict:
    """px, distances to the truth; those of the lens are the largest over the picture."""
    errors = compare_lens(truth, undistortion(lens), zoom.zoom_units)
    center = lens.center[0].numpy() - truth.centre(zoom.zoom_units)
    return {
        "center_error_px": float(np.linalg.norm(center)),
        "largest_error_raw_px": errors.raw_px,
        "largest_error_similarity_px": errors.similarity_px,
        "largest_error_homography_px": errors.homography_px,
    }


def _unweighted(patterns: LinePatterns) -> Problem:
    plain = LinePatterns(patterns.points, patterns.mask, patterns.image_size, patterns.offsets)
    return Problem.from_patterns(plain, torch.tensor(POWERS, dtype=torch.float64))


def _draw_board(
    pictures: tuple[np.ndarray, np.ndarray], simulated: SimulationConfig, out: Path
) -> dict:
    """Figure 3; returns how straight the board's rows and columns are in each picture."""
    columns, rows = simulated.cameras[0].scene.board.squares
    guides, straightness = [], {}
    for key, picture in zip(("before", "after"), pictures, strict=True):
        cv2.imwrite(str(out / f"board_{key}.png"), picture)
        corners = find_corners(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), (columns - 1, rows - 1))
        straightness[f"rms_{key}_px"] = None if corners is None else _bend(corners)
        guides.append([] if corners is None else [*corners, *corners.transpose(1, 0, 2)])
    titles = ("As taken", "Rectified")
    figure = draw_before_after(*pictures, titles=titles, guides=(guides[0], guides[1]))
    save_figure(figure, out / "figure3_checkerboard.png")
    save_figure(draw_before_after(*pictures, titles=titles, grid=46), out / "figure3_with_grid.png")
    return straightness


def _bend(corners: np.ndarray) -> float:
    """px, rms distance of a board's inner corners (rows, columns, 2) to lines through each row and
    column."""
    squared, count = 0.0, 0
    for line in [*corners, *corners.transpose(1, 0, 2)]:
        least = np.linalg.svd(line - line.mean(0), compute_uv=False)[-1]
        squared, count = squared + least**2, count + len(line)
    return float(np.sqrt(squared / count))
