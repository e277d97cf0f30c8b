"""Drives an Axis camera with `sensecam-control`, in the environment that has it.

Reads one JSON object from stdin: address, user, password, and the target pan, tilt (deg) and zoom.
Prints what it saw as JSON. Run it in a folder of its own: the library leaves its picture and its
log there.
"""

import json
import sys
import time
from pathlib import Path

from sensecam_control.vapix_config import CameraConfiguration
from sensecam_control.vapix_control import CameraControl

PATIENCE_S = 20


def settled(control: CameraControl) -> tuple[float, ...]:
    """The position, once two readings in a row agree."""
    deadline, before = time.monotonic() + PATIENCE_S, None
    while (now := control.get_ptz()) != before and time.monotonic() < deadline:
        before = now
        time.sleep(0.3)
    return now


def main() -> None:
    asked = json.load(sys.stdin)
    account = asked["address"], asked["user"], asked["password"]
    control, configuration = CameraControl(*account), CameraConfiguration(*account)
    saw = {
        "type": configuration.get_type_camera().strip(),
        "before": control.get_ptz(),
        "presets": control.list_all_preset(),
        "help": control.info_ptz_comands(),
    }
    move = control.absolute_move(asked["pan"], asked["tilt"], asked["zoom"], speed=90)
    saw["status"] = move.status_code
    saw["after"] = settled(control)
    saw["speed"] = control.get_speed()
    saw["refused"] = configuration.get_jpeg_request(resolution="123x45")
    saw["saved"] = configuration.get_jpeg_request(clock=0, date=0, text=0)
    saw["picture"] = str(next(Path.cwd().glob("*.jpg")))
    control.relative_move(pan=-2.5)
    saw["relative"] = settled(control)
    json.dump(saw, sys.stdout)


if __name__ == "__main__":
    main()
