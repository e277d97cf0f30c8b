"""What may be wrong with a head, and what its calibration is told of it: the rows of the table."""

from __future__ import annotations

from dataclasses import dataclass

from head.body import Imperfections

TOLD_PUPIL = 0.003  # m, sigma of the entrance pupils where they are not what is wrong
UNTOLD_PUPIL = 0.05  # m, and where nobody knows them: the default of `Priors`
DRAWN = "drawn from the priors"


@dataclass(frozen=True)
class Row:
    """One way of not being perfect, and what the calibration is told of the entrance pupil."""

    flaws: Imperfections
    lines_only: bool = False  # what is wrong is what the complete calibration is not told
    pupil_share: float | None = None  # sigma of the pupil over the distance, in place of that in m
    pupil_sigma_m: float = TOLD_PUPIL
    drawn: bool = False  # everything, as `Priors` expects it

    @property
    def pupil_told(self) -> bool:
        """Where the pupils are is known, but for what those of the zooms differ by."""
        return self.pupil_share is None and self.pupil_sigma_m == TOLD_PUPIL

    @property
    def pupil_open(self) -> bool:
        """One pupil, about which nothing is known but how far away it may be."""
        return not (self.pupil_told or self.drawn)

    def pupil_sigma(self, distance: float) -> float:
        """m, as told of a camera with a feature at a distance in m."""
        return self.pupil_sigma_m if self.pupil_share is None else self.pupil_share * distance


def _pupil(share: float) -> Row:
    return Row(Imperfections(pupil_share=share), pupil_share=share)


_TOGETHER = Imperfections(
    boresight_deg=0.2,
    tilt_zero_deg=0.2,
    pupil_m=0.03,
    roll_deg=1,
    jitter=0.3,
    backlash_deg=0.02,
    pixel_aspect=0.985,
)
ROWS = {
    "none": Row(Imperfections()),
    "ray off by a quantum": Row(Imperfections(ray_quanta=1), lines_only=True),
    "ray off by 5 px": Row(Imperfections(ray_px=5), lines_only=True),
    "tilt zero 0.1°": Row(Imperfections(tilt_zero_deg=0.1)),
    "tilt zero 0.5°": Row(Imperfections(tilt_zero_deg=0.5)),
    "boresight 0.1° + 0.1°": Row(Imperfections(boresight_deg=0.1)),
    "boresight 0.3° + 0.3°": Row(Imperfections(boresight_deg=0.3)),
    "pupil 0.5 % of the distance": _pupil(0.005),
    "pupil 1 % of the distance": _pupil(0.01),
    "roll 2°": Row(Imperfections(roll_deg=2)),
    "pixel aspect 0.985": Row(Imperfections(pixel_aspect=0.985)),
    "pixel aspect 0.87": Row(Imperfections(pixel_aspect=0.87)),
    "jitter 0.3 quanta": Row(Imperfections(jitter=0.3)),
    "jitter 1 quantum": Row(Imperfections(jitter=1)),
    "jitter 2 quanta": Row(Imperfections(jitter=2)),
    "backlash 0.05°": Row(Imperfections(backlash_deg=0.05)),
    "lens of another form": Row(Imperfections(other_lens=True)),
    "all together": Row(_TOGETHER, pupil_sigma_m=UNTOLD_PUPIL),
    "all together, pupil told": Row(_TOGETHER),
    DRAWN: Row(Imperfections(), pupil_sigma_m=UNTOLD_PUPIL, drawn=True),
}
