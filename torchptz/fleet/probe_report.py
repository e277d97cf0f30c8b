"""What probing a camera told, in data and in words."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path

from torchptz.cameras import Capabilities
from torchptz.files import without_nan, write_whole

REPORT_NAME = "probe.json"


@dataclass(frozen=True)
class Check:
    """One thing that the device says, and what pictures say of it."""

    name: str
    passed: bool | None  # None: could not be seen
    text: str


@dataclass
class ProbeReport:
    """One camera. Angles in degrees."""

    name: str
    identity: str = ""
    capabilities: dict[str, object] = field(default_factory=dict)
    checks: list[Check] = field(default_factory=list)
    learnt: list[str] = field(default_factory=list)  # what pictures told in place of the device
    notes: list[str] = field(default_factory=list)  # what a user should know or do
    refused: str | None = None  # "camera NAME: cause; way out"
    settling_s: float | None = None  # from stable readings to still pictures, the longest
    repeatability_deg: tuple[float, float] | None = None  # one sigma, of pan and tilt
    backlash_deg: tuple[float, float] | None = None  # of pan and tilt
    moves: int = 0
    seconds: float = 0.0

    @property
    def passed(self) -> bool:
        """Whether the camera can be calibrated as far as probing can tell."""
        return self.refused is None

    def as_dict(self) -> dict[str, object]:
        """Plain data, for JSON."""
        return {**asdict(self), "passed": self.passed}

    def lines(self) -> list[str]:
        """What happened, a line each."""
        signs = {True: "ok", False: "wrong", None: "untested"}
        told = [f"{check.name}: {signs[check.passed]}: {check.text}" for check in self.checks]
        told += [f"learnt: {thing}" for thing in self.learnt]
        if self.settling_s is not None:
            told.append(f"settling: pictures are still {self.settling_s:.2f} s after the readings")
        for what, pair in (
            ("repeatability", self.repeatability_deg),
            ("backlash", self.backlash_deg),
        ):
            if pair is not None:
                told.append(f"{what}: pan {pair[0]:.4f} deg, tilt {pair[1]:.4f} deg")
        return told + [f"note: {note}" for note in self.notes]

    def save(self, folder: Path) -> None:
        """Write `probe.json` into a folder, which is made if missing."""
        text = json.dumps(without_nan(self.as_dict()), indent=1, ensure_ascii=False)
        write_whole(folder / REPORT_NAME, text + "\n")


def described(can: Capabilities) -> dict[str, object]:
    """What a camera can, angles in degrees."""

    def degrees(values: tuple[float, float]) -> list[float]:
        return [round(math.degrees(value), 4) for value in values]

    fov = can.horizontal_fov
    return {
        "pan_deg": "circle" if can.pan_circular else degrees(can.pan_limits),
        "tilt_deg": degrees(can.tilt_limits),
        "quantum_deg": degrees((can.pan_quantum, can.tilt_quantum)),
        "zoom_units": list(can.zoom_limits),
        "max_magnification": can.max_magnification,
        "horizontal_fov_deg": None if fov is None else round(math.degrees(fov), 3),
        "reads_position": can.reads_position,
        "reports_motion": can.reports_motion,
        "scale_sigma": list(can.scale_sigma),
        "tilt_zero_sigma_deg": round(math.degrees(can.tilt_zero_sigma), 4),
    }
