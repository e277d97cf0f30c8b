"""Complete internal calibration: the poses of the head enter the estimate."""

from torchptz.calibration.calibrate import calibrate
from torchptz.calibration.calibration import Calibration
from torchptz.calibration.priors import Priors

__all__ = ["Calibration", "Priors", "calibrate"]
