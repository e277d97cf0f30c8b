"""How one picture's content lies in another: turn, scale and shift from the scene's texture."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from torchptz.cameras import Pose

# Goes to a pose (in the axes as they are believed) and returns a picture at rest and its reading.
Look = Callable[[Pose], tuple[np.ndarray, Pose]]

_WIDTH = 640  # px, pictures are reduced to this: keypoints of large ones tell no more
_KEYPOINTS = 1000
_CONTRAST = 0.015  # of SIFT; walls and asphalt are weak texture, but texture
_RATIO = 0.8  # of the distances to the best and the second-best match (Lowe 2004)
# Of the width. Perspective and the lens's distortion bend a similarity that far at wide angles.
_BEND = 0.02
_FEWEST = 10
_SHARE = 0.2  # of the matches, that must agree
_BY_CHANCE = 6.0  # times as many inliers as random matches would give
_CORE = 0.3  # of the width: the similarity is that of the picture's middle, where lenses bend least
_CELL = 0.08  # of the width; what bends the picture is alike within a cell
_LEAST_ERROR = 0.1  # px of the reduced picture, of one match
_EDGE = 8.0  # DN per px: letters and dirt have edges
_ALIKE = 0.35  # of an edge's gradient: less of a difference is the same edge
_STATIC_SIDE, _STATIC_SHARE = 15, 0.6  # px; of the edges around, so many are the same
_STATIC_REACH = 10  # px around a static edge where keypoints see it


@dataclass(frozen=True)
class Similarity:
    """The second picture shows a point of the first, p, at ``m + shift + scale R (p - m)``.

    m is the middle of the picture, R turns from x to y, which is clockwise as it is seen.
    """

    rotation: float  # rad
    scale: float  # > 1: the second picture shows things larger
    shift: tuple[float, float]  # px
    rotation_sigma: float  # rad, one sigma
    scale_sigma: float  # relative
    shift_sigma: float  # px per axis
    inliers: int  # matches that agree with it
    points: np.ndarray = field(repr=False)  # (inliers, 2, 2) px: in the first, in the second

    @property
    def moved(self) -> float:
        """px, length of the shift."""
        return math.hypot(*self.shift)


def register(
    frame_a: np.ndarray, frame_b: np.ndarray, static: np.ndarray | None = None
) -> Similarity | None:
    """The similarity that takes one picture's content to another's, about the picture's middle.

    Args:
        frame_a, frame_b: (H, W, 3) or (H, W) uint8, of one shape.
        static: (H, W) bool, pixels that belong to no scene (overlaid text, dirt): they must not
            vouch for "no motion". See `static_pixels`.

    Returns:
        None where the pictures share too little texture to be sure.

    Raises:
        ValueError: the shapes differ.

    Source: SIFT (Lowe 2004), RANSAC (Fischler and Bolles 1981), both of OpenCV; then least squares
    over the inliers, by their nearness to the middle.
    """
    if frame_a.shape != frame_b.shape:
        raise ValueError(f"two pictures of one shape wanted, got {frame_a.shape}, {frame_b.shape}")
    (small_a, reduction), (small_b, _) = _reduced(frame_a), _reduced(frame_b)
    height, width = small_a.shape
    free = None
    if static is not None:
        free = cv2.resize(
            (~static).astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST
        )
    pair = _matches(small_a, small_b, free)
    if pair is None:
        return None
    a, b = pair
    bend = _BEND * width
    matrix, inside = cv2.estimateAffinePartial2D(
        a, b, method=cv2.RANSAC, ransacReprojThreshold=bend, maxIters=5000, confidence=0.9999
    )
    if matrix is None:
        return None
    inside = inside[:, 0].astype(bool)
    # Random matches agree with a similarity as often as they hit its circles by chance.
    chance = len(a) * math.pi * bend**2 / (height * width)
    if inside.sum() < max(_FEWEST, _BY_CHANCE * chance, _SHARE * len(a)):
        return None
    # Pixel centres are whole numbers: a reduced pixel's centre is not its number times the factor.
    a, b = ((points[inside] + 0.5) * reduction - 0.5 for points in (a, b))
    return _fitted(a, b, frame_a.shape[1::-1], float(reduction[0]))


def static_pixels(frame_a: np.ndarray, frame_b: np.ndarray) -> np.ndarray:
    """(H, W) bool: where two pictures of DIFFERENT views show the same edges, and around there.

    What stays while the view moves is no scene: overlaid text, a logo, dirt on the dome.
    """
    a, b = (cv2.GaussianBlur(_gray(frame), (3, 3), 0) for frame in (frame_a, frame_b))
    (ax, ay), (bx, by) = (
        [cv2.Sobel(one, cv2.CV_32F, dx, 1 - dx, scale=0.125) for dx in (1, 0)] for one in (a, b)
    )
    # Edges, not brightness: behind letters the scene goes on.
    strong = cv2.max(cv2.magnitude(ax, ay), cv2.magnitude(bx, by))
    edge = strong > _EDGE
    same = edge & (cv2.magnitude(ax - bx, ay - by) < _ALIKE * strong)
    window = (_STATIC_SIDE, _STATIC_SIDE)
    edges, sames = (cv2.blur(one.astype(np.float32), window) for one in (edge, same))
    static = same & (sames > _STATIC_SHARE * edges)
    reach = np.ones((2 * _STATIC_REACH + 1,) * 2, np.uint8)
    return cv2.dilate(static.astype(np.uint8), reach) > 0


def _matches(
    a: np.ndarray, b: np.ndarray, free: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray] | None:
    """(N, 2) px twice, of keypoints that are each other's best match."""
    # The strongest are chosen before the mask is looked at, and letters are the strongest.
    most = _KEYPOINTS if free is None or free.all() else 4 * _KEYPOINTS
    # Without the precise upscaling all keypoints lie a quarter of a pixel beside their places.
    sift = cv2.SIFT_create(nfeatures=most, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    points_a, words_a = sift.detectAndCompute(a, free)
    points_b, words_b = sift.detectAndCompute(b, free)
    if min(len(points_a), len(points_b)) < _FEWEST:
        return None
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    forth = matcher.knnMatch(words_a, words_b, k=2)
    back = {one.queryIdx: one.trainIdx for one in matcher.match(words_b, words_a)}
    good = [
        (first.queryIdx, first.trainIdx)
        for first, second in forth
        if first.distance < _RATIO * second.distance and back[first.trainIdx] == first.queryIdx
    ]
    # One place has several keypoints, one for each of its directions; it has one vote.
    votes = {points_a[i].pt: (points_a[i].pt, points_b[j].pt) for i, j in good}
    if len(votes) < _FEWEST:
        return None
    a, b = (np.array(points, dtype=np.float32) for points in zip(*votes.values(), strict=True))
    return a, b


def _fitted(a: np.ndarray, b: np.ndarray, size: tuple[int, int], reduction: float) -> Similarity:
    """Least squares over inliers, robust, weighted to the middle of both pictures."""
    middle = (np.asarray(size) - 1) / 2
    p, q = a - middle, b - middle
    core = np.exp(-((p**2).sum(-1) + (q**2).sum(-1)) / (4 * (_CORE * size[0]) ** 2)) + 1e-3
    # q = shift + (c, -s; s, c) p
    one, zero = np.ones(len(p)), np.zeros(len(p))
    rows_x = np.stack([one, zero, p[:, 0], -p[:, 1]], -1)
    rows_y = np.stack([zero, one, p[:, 1], p[:, 0]], -1)
    rows = np.stack([rows_x, rows_y], 1)  # (N, 2, 4)
    weight = core
    for _ in range(10):
        normal = np.einsum("n,nij,nik->jk", weight, rows, rows)
        theta = np.linalg.solve(normal, np.einsum("n,nij,ni->j", weight, rows, q))
        left = np.linalg.norm(q - rows @ theta, axis=-1)
        spread = max(1.4826 * float(np.median(left)), _LEAST_ERROR * reduction)
        weight = core / (1 + (left / (2 * spread)) ** 2)
    c, s = theta[2:]
    scale = math.hypot(c, s)
    # Matches of one cell err alike: as many are independent as there are cells.
    cells = np.unique((p // (_CELL * size[0])).astype(int), axis=0)
    alike = max(1.0, len(p) / len(cells))
    variance = max(
        float((weight * left**2).sum() / weight.sum()) / 2, (_LEAST_ERROR * reduction) ** 2
    )
    inverse = np.linalg.inv(normal)
    covariance = (
        variance * alike * inverse @ np.einsum("n,nij,nik->jk", weight**2, rows, rows) @ inverse
    )
    sigma = np.sqrt(np.diag(covariance))
    return Similarity(
        rotation=math.atan2(s, c),
        scale=scale,
        shift=(float(theta[0]), float(theta[1])),
        rotation_sigma=float(sigma[3]) / scale,
        scale_sigma=float(sigma[2]) / scale,
        shift_sigma=float(max(sigma[:2])),
        inliers=len(p),
        points=np.stack([a, b], 1),
    )


def _gray(frame: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) if frame.ndim == 3 else frame


def _reduced(frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Grey picture of _WIDTH at most, and (2,) px of the full picture per px of it."""
    gray = _gray(frame)
    height, width = gray.shape
    if width > _WIDTH:
        gray = cv2.resize(
            gray, (_WIDTH, round(height * _WIDTH / width)), interpolation=cv2.INTER_AREA
        )
    return gray, np.array([width, height]) / gray.shape[::-1]
