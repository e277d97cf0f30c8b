"""Simulated pan-tilt-zoom cameras behind real HTTP, with lenses whose truth is known."""

from .camera import SimulatedCamera
from .comparison import compare_lens
from .config import CameraConfig, SimulationConfig, SimulationError
from .faults import FaultConfig
from .fleet import SimulatedFleet, serve
from .process import Served, serve_in_process
from .truth import CameraTruth, TruthComparison, load_truth, write_truth
from .view import HeadPose

__all__ = [
    "CameraConfig",
    "CameraTruth",
    "FaultConfig",
    "HeadPose",
    "Served",
    "SimulatedCamera",
    "SimulatedFleet",
    "SimulationConfig",
    "SimulationError",
    "TruthComparison",
    "compare_lens",
    "load_truth",
    "serve",
    "serve_in_process",
    "write_truth",
]
