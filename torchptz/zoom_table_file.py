"""The file of a zoom table: JSON, one object a knot.

Read by hand, knot ``k`` maps a picture point ``p`` to ``c + L(r) (p - c)`` with ``c`` its
``center``, ``L(r) = 1 + sum_i coefficients[i] r ** powers[i]`` and
``r = hypot(pixel_aspect (x - c_x), y - c_y) / scale``. ``zoom`` is the measured magnification,
``nominal_zoom`` the one that was asked for.

Where the knot has ``focal_length_px`` and there is a ``principal_point``, the knot's own or else
the table's, the undistorted point ``(u, v)`` is seen along the ray ``K^-1 (u, v, 1)`` of the camera
frame (x right, y down, z forward), with the camera matrix ``K = [[f, 0, ppx],
[0, f pixel_aspect, ppy], [0, 0, 1]]``. The camera centre is the entrance pupil, ``pupil_m`` metres
ahead of the axes of the head.

``covariance`` is of (cx px, cy px, coefficients), ``intrinsics_covariance`` of (cx px, cy px,
coefficients, f px, ppx px, ppy px), with the former as its first block; ``systematic_covariance``
is to be added to that block. A null inside of them stands for infinity: what was not estimated is
not known. Between two knots all runs linearly with the logarithm of ``zoom``, the focal length by
its own logarithm.

Fields that came after the first tables may be missing and then are null, so that readers and files
of one version understand each other.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

from torchptz.files import without_nan, write_whole
from torchptz.lens import RadialLens
from torchptz.zoom_knot import COVARIANCES, Knot

if TYPE_CHECKING:
    from torchptz.zoom_table import ZoomTable

SCHEMA = "torchptz.zoom_table"
SCHEMA_VERSION = 1

_MODEL = (
    "undistorted = c + L(r) (p - c); L(r) = 1 + sum_i coefficients[i] r^powers[i]; "
    "r = hypot(pixel_aspect (x - c_x), y - c_y) / scale; px, x right, y down, "
    "(0, 0) is the centre of the top-left pixel; "
    "ray = K^-1 (undistorted, 1), x right, y down, z forward; "
    "K = [[f, 0, ppx], [0, f pixel_aspect, ppy], [0, 0, 1]] with f = focal_length_px and "
    "(ppx, ppy) = principal_point of the knot, or else of the table; "
    "intrinsics_covariance: of (c_x, c_y, coefficients, f, ppx, ppy); null in it: not known"
)
_NUMBERS = (
    "nominal_zoom",
    "zoom_units",
    "rms_px",
    "gain",
    "gain_sigma",
    "focal_length_px",
    "focal_length_sigma_px",
    "pupil_m",
    "pupil_sigma_m",
)
_COUNTS = ("points", "lines")
# Fields of a knot that the first tables lack.
_LATER = (
    *("systematic_covariance", "principal_point", "intrinsics_covariance"),
    *("pupil_m", "pupil_sigma_m"),
)


def write_table(table: ZoomTable, path: str | Path) -> None:
    """Write a table as JSON."""
    lens = next((knot.lens for knot in table.knots if knot.lens is not None), None)
    stored = {
        "schema": SCHEMA,
        "version": SCHEMA_VERSION,
        "created_by": table.created_by,
        "camera": table.camera,
        "model": _MODEL,
        "image_size": None if lens is None else lens.image_size[0].tolist(),
        "pixel_aspect": None if lens is None else lens.pixel_aspect[0].item(),
        "scale": None if lens is None else lens.scale[0].item(),
        "powers": None if lens is None else lens.powers.tolist(),
        "principal_point": _list(table.principal_point),
        "principal_point_covariance": _list(table.principal_point_covariance),
        "knots": [
            {
                "zoom": knot.zoom,
                "status": knot.status,
                "usable": knot.usable,
                "center": None if knot.lens is None else knot.lens.center[0].tolist(),
                "coefficients": None if knot.lens is None else knot.lens.coefficients[0].tolist(),
                "principal_point": _list(knot.principal_point),
                **{name: without_nan(_list(getattr(knot, name))) for name in COVARIANCES},
                **{name: getattr(knot, name) for name in (*_NUMBERS, *_COUNTS)},
            }
            for knot in table.knots
        ],
    }
    write_whole(path, _readable(stored) + "\n")


def read_table(path: str | Path, table_type: type[ZoomTable]) -> ZoomTable:
    """Read what `write_table` wrote; see `ZoomTable.load`."""
    try:
        stored = json.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:  # neither text nor JSON
        raise ValueError(f"{path}: not a zoom table, not even JSON ({error})") from error
    try:
        return _table(stored, table_type)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _table(stored: object, table_type: type[ZoomTable]) -> ZoomTable:
    if not isinstance(stored, dict) or stored.get("schema") != SCHEMA:
        found = stored.get("schema") if isinstance(stored, dict) else type(stored).__name__
        raise ValueError(f"schema is {found!r}; a zoom table has {SCHEMA!r}")
    if stored.get("version") != SCHEMA_VERSION:
        raise ValueError(
            f"version is {stored.get('version')!r}; this torchptz reads version {SCHEMA_VERSION}: "
            "use the torchptz that wrote it, or a later one"
        )
    knots = _field(stored, "knots", "")
    if not isinstance(knots, list):
        raise ValueError("knots must be a list")
    return table_type(
        camera=_text(stored, "camera", ""),
        knots=tuple(_knot(knot, f"knots[{i}].", stored) for i, knot in enumerate(knots)),
        principal_point=_array(stored, "principal_point", "", (2,), optional=True),
        principal_point_covariance=_array(
            stored, "principal_point_covariance", "", (2, 2), optional=True
        ),
        created_by=_text(stored, "created_by", ""),
    )


def _knot(knot: object, where: str, stored: dict) -> Knot:
    if not isinstance(knot, dict):
        raise ValueError(f"{where[:-1]} must be an object")
    knot = dict.fromkeys(_LATER) | knot
    usable = _field(knot, "usable", where)
    if not isinstance(usable, bool):
        raise ValueError(f"{where}usable must be true or false, not {usable!r}")
    lens, covariances = None, {}
    center = _array(knot, "center", where, (2,), optional=not usable)
    if center is not None:
        powers = _array(stored, "powers", "", (None,))
        lens = {
            "center": [center],
            "coefficients": [_array(knot, "coefficients", where, (len(powers),))],
            "powers": powers,
            "scale": _array(stored, "scale", "", ()),
            "image_size": _array(stored, "image_size", "", (2,)),
            "pixel_aspect": _array(stored, "pixel_aspect", "", ()),
        }
        covariances = {
            name: _covariance(knot, name, where, count + len(powers))
            for name, count in COVARIANCES.items()
        }
    numbers = {name: _array(knot, name, where, (), optional=True) for name in _NUMBERS}
    counts = {name: _array(knot, name, where, (), optional=True) for name in _COUNTS}
    status, zoom = _text(knot, "status", where), _array(knot, "zoom", where, ())
    try:
        return Knot(
            zoom=zoom,
            lens=None if lens is None else RadialLens(**lens),
            status=status,
            usable=usable,
            principal_point=_array(knot, "principal_point", where, (2,), optional=True),
            **covariances,
            **numbers,
            **{name: None if count is None else int(count) for name, count in counts.items()},
        )
    except ValueError as error:
        raise ValueError(f"{where[:-1]}: {error}") from error


def _field(stored: dict, name: str, where: str) -> object:
    if name not in stored:
        raise ValueError(f"{where}{name} is missing")
    return stored[name]


def _text(stored: dict, name: str, where: str) -> str:
    value = _field(stored, name, where)
    if not isinstance(value, str):
        raise ValueError(f"{where}{name} must be a text, not {value!r}")
    return value


def _array(
    stored: dict, name: str, where: str, shape: tuple[int | None, ...], *, optional: bool = False
) -> object:
    """Finite numbers of a shape (None: any length), or None if the field is optional and null."""
    value = _field(stored, name, where)
    if value is None and optional:
        return None
    if not _fits(value, shape):
        length = "x".join("n" if n is None else str(n) for n in shape)
        wanted = f"a list of {length} finite numbers" if shape else "a finite number"
        raise ValueError(f"{where}{name} must be {wanted}, not {value!r}")
    return value


def _covariance(knot: dict, name: str, where: str, size: int) -> object:
    """As `_array`, with null inside of the matrix for infinity."""
    value = _field(knot, name, where)
    if value is None:
        return None
    _array({name: _filled(value, 0.0)}, name, where, (size, size))
    return _filled(value, math.inf)


def _filled(value: object, number: float) -> object:
    """Nested lists with a number in place of every null."""
    if isinstance(value, list):
        return [_filled(inner, number) for inner in value]
    return number if value is None else value


def _fits(value: object, shape: tuple[int | None, ...]) -> bool:
    if not shape:
        return (
            isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        )
    right = isinstance(value, list) and (shape[0] in (None, len(value)))
    return right and all(_fits(inner, shape[1:]) for inner in value)


def _list(tensor: object) -> list | None:
    return None if tensor is None else tensor.tolist()


def _readable(value: object, indent: str = "") -> str:
    """JSON with objects spread over lines and lists of numbers kept on one."""
    deeper = indent + "  "
    if isinstance(value, dict):
        inner = [f"{deeper}{json.dumps(k)}: {_readable(v, deeper)}" for k, v in value.items()]
        return "{\n" + ",\n".join(inner) + f"\n{indent}}}"
    if isinstance(value, list) and any(isinstance(v, dict) for v in value):
        return "[\n" + ",\n".join(deeper + _readable(v, deeper) for v in value) + f"\n{indent}]"
    return json.dumps(value, allow_nan=False, ensure_ascii=False)
