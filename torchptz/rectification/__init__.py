"""Pictures without the distortion of their lens."""

from torchptz.rectification.canvas import Canvas, canvas_of
from torchptz.rectification.rectify import backend_for, prepare, rectify, sampling_map

__all__ = ["Canvas", "backend_for", "canvas_of", "prepare", "rectify", "sampling_map"]
