"""From what was collected in a run to a table of lenses per camera, all in one batch."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torchptz.fleet.head_solution import solve_heads
from torchptz.fleet.line_solution import solve_lines
from torchptz.fleet.observations import has_journal
from torchptz.fleet.records import RECORD_NAME, CameraRecord
from torchptz.fleet.solution import Solution
from torchptz.fleet.summary import CameraResult, Summary
from torchptz.zoom_table import ZoomTable

TABLE_NAME, SUMMARY_NAME = "table.json", "summary.json"
# Of the ways that are there to compare with.
TABLE_NAME_LINES = "table_lines_only.json"
SUMMARY_NAME_LINES = "summary_lines_only.json"
TABLE_NAME_WITHOUT = "table_without_offsets.json"
SUMMARY_NAME_WITHOUT = "summary_without_offsets.json"


def solve(
    run: str | Path,
    powers: Sequence[float] | str = (1, 2, 3),
    *,
    method: str = "ml",
    robust: bool = True,
    head: bool = True,
    offsets: bool = True,
    cameras: Sequence[str] | None = None,
    **options: object,
) -> Summary:
    """Estimate the lenses of all cameras and zooms of a run; write a table for each camera.

    Cameras that were collected with their heads are calibrated from all their poses
    (`torchptz.calibrate`); photographs and sets of lines from their lines alone (`estimate`).

    Args:
        run: folder with one folder a camera, as collection leaves it.
        powers, robust: as for `calibrate` and `estimate`.
        method: as for `estimate`; other than "ml", of lines alone. With "ml", a principal point
            that was measured is where the centre of lines is expected, give or take 5 px beside
            what it is uncertain by: the distortion has a centre of its own.
        head: estimate what the heads are like, too. Without, lines alone are used, and a head's
            geometry is believed. The results go to files of other names, so that both can be
            compared.
        offsets: use the known offsets of the points of lines, where there are any. Without, lines
            alone are used, the results go to files of other names, too, and ``robust`` is off:
            points that a head's rounding put beside their lines are the rule, not outliers.
        cameras: names of those to solve; default all that have been collected there.
        options: more of `estimate`'s.

    Returns:
        Summary, as written to the run's folder. A camera that failed, in collection or now, is
        reported in it and stops no other.

    Raises:
        ValueError: no folder, or none of the cameras in it; a method that lines alone have; and
            what `calibrate` and `estimate` refuse.
    """
    run = Path(run)
    records = _records(run, cameras)
    readable = {name: one for name, one in records.items() if isinstance(one, CameraRecord)}
    moved = {
        name: record
        for name, record in readable.items()
        if head and offsets and record.zooms and has_journal(run / name)
    }
    check_method([*moved], method=method)
    still = {name: record for name, record in readable.items() if name not in moved}
    solutions = solve_heads(run, moved, powers, robust=robust) | solve_lines(
        run, still, powers, offsets=offsets, method=method, robust=robust and offsets, **options
    )
    table_name, summary_name = TABLE_NAME, SUMMARY_NAME
    if not offsets:
        table_name, summary_name = TABLE_NAME_WITHOUT, SUMMARY_NAME_WITHOUT
    elif not head:
        table_name, summary_name = TABLE_NAME_LINES, SUMMARY_NAME_LINES
    summary = Summary(
        {
            name: CameraResult((), None, record)
            if isinstance(record, str)
            else _written(run / name / table_name, record, solutions[name])
            for name, record in records.items()
        }
    )
    summary.save(run / summary_name)
    return summary


def check_method(
    moved: Sequence[str],
    *,
    method: str = "ml",
    head: bool = True,
    offsets: bool = True,
    **_: object,
) -> None:
    """Refuse a method that lines alone have, where heads are estimated.

    moved: names of the cameras that move. The rest: as for `solve`.

    Raises:
        ValueError: says how to have it.
    """
    if moved and head and offsets and method != "ml":
        raise ValueError(
            f"method {method} knows lines alone, and {moved[0]} is a camera with a head: add "
            "--lines-only (head=False)"
        )


def _records(run: Path, cameras: Sequence[str] | None) -> dict[str, CameraRecord | str]:
    """Records by name, or why one cannot be had."""
    if not run.is_dir():
        raise ValueError(f"{run}: there is no such folder")
    folders = sorted(path.parent for path in run.glob(f"*/{RECORD_NAME}"))
    if cameras is not None:
        there = {folder.name for folder in folders}
        folders = [run / name for name in cameras] if there.intersection(cameras) else []
    if not folders:
        wanted = "no camera" if cameras is None else f"none of {', '.join(cameras)}"
        raise ValueError(
            f"{run}: {wanted} has been collected there (no */{RECORD_NAME}); give the folder that "
            "was given to collect"
        )
    records: dict[str, CameraRecord | str] = {}
    for folder in folders:
        try:
            records[folder.name] = CameraRecord.load(folder)
        except FileNotFoundError:
            records[folder.name] = f"{folder}: nothing was collected there (no {RECORD_NAME})"
        except (OSError, ValueError) as error:
            records[folder.name] = str(error)
    return records


def _written(path: Path, record: CameraRecord, solution: Solution) -> CameraResult:
    """What became of a camera, its table written if it has a lens."""
    error = record.error or record.untrue or solution.error
    if error is None and not record.finished:
        error = "collection was interrupted; the table has what was finished"
    if error is None and not solution.zooms:
        error = "no zoom was collected"
    # The table of an earlier run must not pass for this one's.
    path.unlink(missing_ok=True)
    table = None
    if record.untrue is None and any(knot.usable for knot in solution.knots):
        try:
            ZoomTable(
                record.name,
                tuple(sorted(solution.knots, key=lambda knot: knot.zoom)),
                solution.principal_point,
                solution.principal_point_covariance,
            ).save(path)
            table = f"{path.parent.name}/{path.name}"
        except ValueError as problem:
            error = error or str(problem)
    return CameraResult(
        solution.zooms, table, error, solution.head, solution.undetermined, record.views_ended
    )
