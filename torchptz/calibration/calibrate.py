"""`calibrate`: what heads read and cameras saw in, complete internal calibrations out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchptz.calibration import parameters as at
from torchptz.calibration.calibration import Calibration
from torchptz.calibration.marginal import Noise
from torchptz.calibration.misfit import misfit_of
from torchptz.calibration.priors import Known, Priors, known_of
from torchptz.calibration.problem import Problem
from torchptz.calibration.refinement import Refined, inliers, refine
from torchptz.calibration.start import start_of
from torchptz.calibration.verdict import statuses
from torchptz.lens import checked_powers
from torchptz.observations import Observations

_VAGUE_FOCAL = 0.5  # relative, about the start, where no prior tells: keeps a lone look solvable
_ROUGH_ROUNDS, _SETTLED_ROUGHLY = 5, 0.1  # until outliers can be told
_SELECTIONS = 3  # times that inliers are chosen again
_FEW, _MANY = (1, 2, 3), (1, 2, 3, 4, 5)  # powers that "auto" chooses from
_STRANGE = 10.0  # times a sigma that was assumed
_CHUNK = 2**25  # numbers in the largest tensor of a part of the batch


def calibrate(
    observations: Observations,
    priors: Priors | None = None,
    powers: Sequence[float] | str = (1, 2, 3),
    robust: bool = True,
    backend: str = "auto",
) -> Calibration:
    """Complete internal calibration of every camera of a batch from the poses of its head.

    Maximum likelihood in distorted pixels, both coordinates of every point, of each zoom's focal
    length, lens, principal point and entrance pupil, and of the rays, tilt zero, boresight, roll
    and backlash that the zooms of a camera share. Readings are noisy: what a stop's reading erred
    by is marginalised, and how much that is, is learnt. Nothing about the head is believed without
    a sigma; what the data cannot tell stays at its prior (`Calibration.undetermined`).

    Args:
        observations: C cameras, all zooms and features together: the long end pins the head, and
            the head pins the wide end.
        priors: default `Priors()`.
        powers: K positive, increasing powers of r in L; or "auto", which gives the zooms that 1, 2
            and 3 cannot follow two more. Coefficients that a zoom does not need are 0.
        robust: set outlying observations aside.
        backend: "torch" on any device, "numba" for compiled kernels on a CPU; "auto": kernels where
            they can be. Both find the same, to rounding.

    Returns:
        Calibration. Cameras are independent: a bad one gets its own statuses and changes no
        other's numbers.

    Raises:
        ValueError: priors, powers or a backend that do not fit.

    Source: README, "Beyond the paper".
    """
    priors = priors or Priors()
    if not isinstance(powers, str):
        return _in_parts(observations, priors, checked_powers(powers), robust, backend)
    if powers != "auto":
        raise ValueError(f'powers are numbers, or "auto", not {powers!r}')
    first = _in_parts(observations, priors, checked_powers(_FEW), robust, backend)
    return _in_parts(
        observations,
        priors,
        checked_powers(_MANY),
        robust,
        backend,
        first.misfit[..., 2, 2] > 0,
    )


def _in_parts(
    observations: Observations,
    priors: Priors,
    powers: Tensor,
    robust: bool,
    backend: str,
    richer: Tensor | None = None,
) -> Calibration:
    """Calibrate as many cameras at a time as the memory is good for.

    richer: (C, Z) bool, zooms that have all powers and not only the first few; None: all have.
    """
    problem = Problem.from_observations(observations, powers, backend)
    known = known_of(priors, observations, problem.layout, problem.used)
    if richer is not None:
        known = known.with_coefficients_held(problem.layout, len(_FEW), ~richer)
    noise = _assumed_noise(priors, observations)
    size = 2 * problem.pixel.shape[1] * problem.layout.compact
    step = max(1, _CHUNK // max(1, size))
    parts = [slice(begun, begun + step) for begun in range(0, len(observations), step)]
    learn = not priors.reading_known
    with torch.no_grad():
        found = Calibration.cat(
            [
                _calibrated(observations[p], problem[p], known[p], noise[p], learn, robust)
                for p in parts
            ]
        )
    if richer is None:
        return found
    # Whether the first few are enough was seen before.
    return replace(found, misfit=torch.where(richer[..., None, None], found.misfit, 0.0))


def _calibrated(
    observations: Observations,
    problem: Problem,
    known: Known,
    noise: Noise,
    learn: bool,
    robust: bool,
) -> Calibration:
    theta, known = _started(problem, observations, known, noise)
    noise_assumed, assumed = noise, noise if learn else None
    if robust:
        # Before outliers are told from a start that is off, nothing is learnt from them, and no
        # zoom gets its way with what others depend on.
        rough = {"heavy_tails": True, "settled": _SETTLED_ROUGHLY, "rounds": _ROUGH_ROUNDS}
        lenses = refine(problem, theta, known.of_lenses(problem.layout), noise, **rough)
        far = refine(problem, lenses.theta, known, noise, **rough)
        near = refine(problem, far.theta, known, noise, assumed=assumed, **rough)
        taken = lenses.iterations + far.iterations + near.iterations
        theta, noise = near.theta, near.noise
        good = inliers(problem, near)
    else:
        good, taken = problem.used, torch.zeros_like(known.mean[:, 0], dtype=torch.long)
    chosen = problem.using(good.to(problem.weight))
    refined = refine(chosen, theta, known, noise, assumed=assumed)
    for _ in range(_SELECTIONS if robust else 0):
        good = inliers(problem, refined)
        changed = (good != chosen.used).any(1)
        if not bool(changed.any()):
            break
        # Those whose inliers stand are done, whatever becomes of the others.
        chosen = problem.using(torch.where(changed[:, None], good.to(chosen.weight), chosen.weight))
        again = refine(chosen, refined.theta, known, refined.noise, assumed=assumed)
        again = replace(again, iterations=refined.iterations + again.iterations)
        refined = again.where(changed, refined)
    refined = replace(refined, iterations=taken + refined.iterations)
    return _summed_up(observations, problem, chosen, known, refined, noise_assumed)


def _assumed_noise(priors: Priors, o: Observations) -> Noise:
    """A head that stops anywhere and reports the nearest multiple of its quantum."""
    like = {"dtype": o.quantum.dtype, "device": o.quantum.device}
    repeatability = torch.as_tensor(priors.repeatability, **like).reshape(-1, 1)
    if len(repeatability) not in {1, len(o)}:
        raise ValueError(f"repeatability must be a number or of shape {(len(o),)}")
    head = (o.quantum**2 / 12 + repeatability**2).clamp_min(_FINEST_READING**2)
    return Noise(head.expand(len(o), 2), torch.ones_like(head[:, 0]))


# rad: of a head without a quantum or with a very fine one, sought about and never called strange
_FINEST_READING, _PLAUSIBLE_READING = 1e-5, 3e-4


def _started(problem: Problem, o: Observations, known: Known, noise: Noise) -> tuple[Tensor, Known]:
    """Start (C, T), and the priors about it.

    Where the scale of an axis is open, so is its sign: the four ways are tried, and that which the
    observations fit best is taken.
    """
    layout = problem.layout
    axes = layout.zooms * layout.per_zoom + torch.arange(len(at.HEAD), device=o.zoom.device)
    axes = axes[at.AXIS_SCALE]
    theta, about = _start_with_priors(problem, o, known)
    open_axes = known.free[:, axes]  # (C, 2)
    if not bool(open_axes.any()):
        return theta, about
    best = torch.full_like(theta[:, 0], torch.inf)
    for signs in ((1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)):
        turned = torch.where(open_axes, torch.tensor(signs).to(theta), 1.0)
        mean = known.mean.index_copy(1, axes, known.mean[:, axes] * turned)
        begun, priors = _start_with_priors(problem, o, replace(known, mean=mean))
        tried = refine(problem, begun, priors, noise, heavy_tails=True, rounds=2)
        away = torch.where(problem.used, tried.distance, torch.nan).nanmedian(1).values
        better = away.nan_to_num(torch.inf) < best
        best = torch.where(better, away, best)
        theta = torch.where(better[:, None], begun, theta)
        about = priors.where(better, about)
    return theta, about


def _start_with_priors(problem: Problem, o: Observations, known: Known) -> tuple[Tensor, Known]:
    """Start (C, T), and the priors with a vague one about it for focal lengths without any."""
    theta = start_of(problem, o, known)
    level = torch.arange(problem.layout.zooms, device=theta.device) * problem.layout.per_zoom
    level = level + at.LOG_FOCAL
    untold = known.sigma[:, level].isinf()
    mean = torch.where(untold, theta[:, level], known.mean[:, level])
    sigma = torch.where(untold, _VAGUE_FOCAL, known.sigma[:, level])
    return theta, Known(
        known.mean.index_copy(1, level, mean), known.sigma.index_copy(1, level, sigma)
    )


def _summed_up(
    o: Observations,
    problem: Problem,
    chosen: Problem,
    known: Known,
    refined: Refined,
    assumed: Noise,
) -> Calibration:
    layout = problem.layout
    level = torch.arange(layout.zooms, device=o.zoom.device)
    of_zoom = o.zoom.unsqueeze(1) == level[:, None]  # (C, Z, N)
    seen = (of_zoom & problem.used.unsqueeze(1)).sum(2)
    kept = (of_zoom & chosen.used.unsqueeze(1)).sum(2)
    squares = refined.residual.square().sum(-1).unsqueeze(1)
    rms = (torch.where(of_zoom & chosen.used.unsqueeze(1), squares, 0.0).sum(2) / (2 * kept)).sqrt()
    calibration = Calibration(
        camera=list(o.camera),
        zooms=o.zooms,
        exists=seen > 0,
        image_size=o.image_size,
        powers=problem.powers,
        layout=layout,
        theta=refined.theta,
        covariance=refined.covariance,
        misfit=rms.new_zeros(*rms.shape, 5 + layout.powers, 5 + layout.powers),
        known=known,
        reading_sigma=refined.noise.head.sqrt(),
        noise_factor=refined.noise.pixel.sqrt(),
        rms_px=rms,
        residuals=torch.where(problem.used.unsqueeze(-1), refined.residual, 0.0),
        distances=torch.where(problem.used, refined.distance.sqrt(), 0.0),
        inliers=chosen.used,
        iterations=refined.iterations,
        status=[[] for _ in o.camera],
    )
    grown = replace(calibration, misfit=misfit_of(chosen, refined, known))
    # Beyond what any head or detection does, it is not noise.
    usual = assumed.head.clamp_min(_PLAUSIBLE_READING**2)
    strange = (refined.noise.head > _STRANGE**2 * usual).any(1)
    strange |= refined.noise.pixel > _STRANGE**2 * assumed.pixel
    return replace(
        grown, status=statuses(calibration, grown, seen, kept, refined.converged, strange)
    )
