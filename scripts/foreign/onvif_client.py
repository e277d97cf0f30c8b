"""Drives an ONVIF device with the library `onvif-zeep-async`, in the environment that has it.

Reads one JSON object from stdin: address, user, password, and the target x, y, zoom in the units of
the first position space that the device declares. Prints what it saw as JSON; leaves the picture in
the current folder.
"""

import asyncio
import json
import sys
from pathlib import Path

from onvif import ONVIFCamera

POLLS, PAUSE_S = 60, 0.1


async def drive(asked: dict) -> dict:
    host, _, port = asked["address"].partition(":")
    # adjust_time: tokens are stamped with the device's clock
    camera = ONVIFCamera(host, int(port), asked["user"], asked["password"], adjust_time=True)
    try:
        await camera.update_xaddrs()
        capabilities = await camera.get_capabilities()
        device = await camera.create_devicemgmt_service()
        information = await device.GetDeviceInformation()
        media, ptz = await camera.create_media_service(), await camera.create_ptz_service()
        profiles = await media.GetProfiles()
        profile = next(one for one in profiles if one.PTZConfiguration is not None)
        options = await ptz.GetConfigurationOptions(
            {"ConfigurationToken": profile.PTZConfiguration.token}
        )
        nodes = await ptz.GetNodes()
        imaging = await camera.create_imaging_service()
        source = {"VideoSourceToken": profile.VideoSourceConfiguration.SourceToken}
        settings = await imaging.GetImagingSettings(source)
        space = options.Spaces.AbsolutePanTiltPositionSpace[0]
        before = await ptz.GetStatus({"ProfileToken": profile.token})
        await ptz.AbsoluteMove(
            {
                "ProfileToken": profile.token,
                "Position": {
                    "PanTilt": {"x": asked["x"], "y": asked["y"], "space": space.URI},
                    "Zoom": {"x": asked["zoom"]},
                },
            }
        )
        after = await settled(ptz, profile.token)
        picture = Path("picture.jpg").absolute()
        picture.write_bytes(await camera.get_snapshot(profile.token))
        return {
            "model": information.Model,
            "services": sorted(camera.xaddrs),
            "ptz_address": capabilities["PTZ"]["XAddr"],
            "profiles": [one.token for one in profiles],
            "picture_size": [
                profile.VideoEncoderConfiguration.Resolution.Width,
                profile.VideoEncoderConfiguration.Resolution.Height,
            ],
            "space": space.URI,
            "x_range": [space.XRange.Min, space.XRange.Max],
            "y_range": [space.YRange.Min, space.YRange.Max],
            "node_spaces": [
                one.URI for one in nodes[0].SupportedPTZSpaces.AbsolutePanTiltPositionSpace
            ],
            "focus": settings.Focus.AutoFocusMode,
            "before": position(before),
            "after": position(after),
            "move_status": after.MoveStatus.PanTilt if after.MoveStatus else None,
            "picture": str(picture),
        }
    finally:
        await camera.close()


async def settled(ptz, token: str):
    """The status, once two in a row agree and nothing moves any more."""
    before = None
    for _ in range(POLLS):
        now = await ptz.GetStatus({"ProfileToken": token})
        moving = now.MoveStatus is not None and now.MoveStatus.PanTilt == "MOVING"
        if before is not None and position(before) == position(now) and not moving:
            break
        before = now
        await asyncio.sleep(PAUSE_S)
    return now


def position(status) -> list[float]:
    pan_tilt, zoom = status.Position.PanTilt, status.Position.Zoom
    return [pan_tilt.x, pan_tilt.y, zoom.x]


if __name__ == "__main__":
    json.dump(asyncio.run(drive(json.load(sys.stdin))), sys.stdout)
