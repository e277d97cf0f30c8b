"""How a dialect counts zoom: its device units against the zoom motor's (the body's) own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .optics import DIGITAL_FACTOR, DIGITAL_UNITS, OPTICAL_UNITS, Optics


@dataclass(frozen=True)
class TableScale:
    """Linear between points; beyond them it stays at its ends."""

    device: tuple[float, ...]  # ascending
    body: tuple[float, ...]  # ascending

    def to_body(self, device_units: float) -> float:
        return float(np.interp(device_units, self.device, self.body))

    def to_device(self, body_units: float) -> float:
        return float(np.interp(body_units, self.body, self.device))


@dataclass(frozen=True)
class MagnificationScale:
    """The device counts magnification, in steps of `per_unit`."""

    optics: Optics
    per_unit: float

    def to_body(self, device_units: float) -> float:
        magnification, most = device_units * self.per_unit, self.optics.max_magnification
        if magnification <= most:
            return self.optics.zoom_units(magnification)
        share = min((magnification / most - 1) / (DIGITAL_FACTOR - 1), 1.0)
        return OPTICAL_UNITS + share * (DIGITAL_UNITS - OPTICAL_UNITS)

    def to_device(self, body_units: float) -> float:
        return round(self.optics.magnification(body_units) / self.per_unit, 9)  # its end exactly


ZoomScale = TableScale | MagnificationScale

_TABLES = {
    "axis": ((1.0, 9999.0, 19999.0), (0.0, float(OPTICAL_UNITS), float(DIGITAL_UNITS))),
    "onvif": ((0.0, 1.0), (0.0, float(OPTICAL_UNITS))),
}
_ITS_OWN = ((0.0, float(DIGITAL_UNITS)),) * 2  # the Sonys count as the motor does


def scale_of(dialect: str, optics: Optics) -> ZoomScale:
    """The scale of a dialect's devices."""
    if dialect == "hikvision":
        return MagnificationScale(optics, 0.1)
    return TableScale(*_TABLES.get(dialect, _ITS_OWN))


def scale_to_json(scale: ZoomScale) -> dict:
    if isinstance(scale, MagnificationScale):
        return {"magnification_per_unit": scale.per_unit}
    return {"device": list(scale.device), "body": list(scale.body)}


def scale_from_json(data: dict, optics: Optics) -> ZoomScale:
    """Raises KeyError where the data are of no scale."""
    if "magnification_per_unit" in data:
        return MagnificationScale(optics, data["magnification_per_unit"])
    return TableScale(tuple(data["device"]), tuple(data["body"]))
