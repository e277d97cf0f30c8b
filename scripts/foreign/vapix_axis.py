"""Drives an Axis camera with the library `axis`, in the environment that has it.

Reads one JSON object from stdin: address, user, password, and the target pan, tilt (deg) and zoom.
Prints what it saw as JSON; leaves the picture in the current folder.
"""

import asyncio
import json
import sys
from pathlib import Path

import httpx
from axis.device import AxisDevice
from axis.models.configuration import Configuration
from axis.models.ptz_cgi import PtzQuery

POLLS, PAUSE_S = 60, 0.3


async def position(device: AxisDevice) -> dict[str, str]:
    told = (await device.vapix.ptz.query(PtzQuery.POSITION)).decode()
    return dict(line.split("=") for line in told.splitlines())


async def settled(device: AxisDevice) -> dict[str, str]:
    """The position, once two readings in a row agree."""
    before = None
    for _ in range(POLLS):
        now = await position(device)
        if now == before:
            break
        before = now
        await asyncio.sleep(PAUSE_S)
    return now


async def drive(asked: dict) -> dict:
    host, _, port = asked["address"].partition(":")
    async with httpx.AsyncClient(trust_env=False) as session:
        device = AxisDevice(
            Configuration(
                session, host, port=int(port), username=asked["user"], password=asked["password"]
            )
        )
        vapix = device.vapix
        await vapix.initialize_param_cgi(preload_data=False)
        ptz = vapix.params.ptz_handler["0"]
        limits = ptz.limits["1"]
        saw = {
            "product": vapix.product_number,
            "serial": vapix.serial_number,
            "enabled": ptz.image_source["0"].ptz_enabled,
            "pan": [limits.min_pan, limits.max_pan],
            "tilt": [limits.min_tilt, limits.max_tilt],
            "zoom": [limits.min_zoom, limits.max_zoom],
            "field_angle": [limits.min_field_angle, limits.max_field_angle],
            "limits": (await vapix.ptz.query(PtzQuery.LIMITS)).decode(),
            "driver": (await vapix.ptz.configured_device_driver()).decode().strip(),
            "before": await position(device),
        }
        await vapix.ptz.control(
            pan=asked["pan"], tilt=asked["tilt"], zoom=asked["zoom"], auto_focus=False, speed=80
        )
        saw["after"] = await settled(device)
        picture = Path("picture.jpg").absolute()
        wanted = {"camera": "1", "text": "0", "clock": "0", "date": "0"}
        picture.write_bytes(await vapix.request("get", "/axis-cgi/jpg/image.cgi", params=wanted))
        saw["picture"] = str(picture)
        return saw


if __name__ == "__main__":
    json.dump(asyncio.run(drive(json.load(sys.stdin))), sys.stdout)
