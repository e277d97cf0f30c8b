"""Every fault of the simulated cameras, and what may become of a camera that has it."""

from __future__ import annotations

from dataclasses import dataclass, field

# Words of refusals, as regular expressions.
_DEAF = r"does not move|does not follow|view from before|did not move|nothing moves"
_ELSEWHERE = r"stopped elsewhere|where the scan began|still moving"
_STEERED = r"another user|moved \d+ times|did not come to rest|stopped elsewhere|where the scan"
_UNTRUE = r"where the scan began|come to rest|outliers|misfit|not be trusted"
_NO_ANSWER = r"cannot be reached|silent|did not accept|hung up|closed the connection|longer than"
_NO_SENSE = r"HTTP|bytes|headers?|answer"
_LOST = r"feature (was|is) (lost|not)|no feature|not seen|not found|only \d+ of"


@dataclass(frozen=True)
class Case:
    """A fault on a camera of a dialect that can have it."""

    faults: dict[str, object]  # by their names in the simulator's FaultConfig
    dialect: str = "sony_rz30"
    refusals: str = r"(?!)"  # of what a refusal must speak; default: it must not be refused
    table: bool = True  # a table within its sigmas is a right outcome, too
    simulated: dict[str, object] = field(default_factory=dict)  # changes of the simulated camera
    config: dict[str, object] = field(default_factory=dict)  # changes of its configuration
    later: bool = False  # switched on only when the first lines are scanned
    password: str | None = None  # a wrong one
    name: str = ""  # default: the fault's

    @property
    def title(self) -> str:
        """What a table calls it."""
        words = self.name or ", ".join(
            key
            if value is True
            else f"{key} {value:g}"
            if isinstance(value, float)
            else f"{key} {value}"
            for key, value in self.faults.items()
        )
        return f"{words}, later" if self.later else words


def _on(fault: str, value: object = True, /, dialect: str = "sony_rz30", **more: object) -> Case:
    return Case({fault: value}, dialect, **more)


CASES: tuple[Case, ...] = (
    # nothing wrong, in each dialect
    *(
        Case({}, dialect, name="nothing")
        for dialect in ("sony_rz30", "sony_named", "sony_srg", "axis", "onvif", "hikvision")
    ),
    # the server
    _on("refuse_connections", refusals=_NO_ANSWER, table=False),
    _on("refuse_connections", refusals=_NO_ANSWER, table=False, later=True),
    _on("slow_reply_s", 0.02),
    _on("busy_every", 9),
    _on("busy_every", 1, refusals="busy", table=False),
    _on("double_cr"),
    _on("truncated_jpeg_every", 5),
    _on("truncated_jpeg_every", 1, refusals="cut|picture", table=False),
    _on("truncated_jpeg_with_length_every", 5),
    _on("one_shot_nonce", dialect="axis"),
    _on("one_shot_nonce", dialect="hikvision"),
    _on("connection_cap", 1, "axis", refusals="limit of connections", table=False),
    _on("connection_cap", 6, "axis", refusals="limit of connections", later=True),
    _on("lockout_after", 5, password="wrong", refusals="refuses the credentials", table=False),
    _on("lockout_after", 5, "axis", password="wrong", refusals="credentials", table=False),
    _on("lockout_after", 5, "onvif", password="wrong", refusals="credentials", table=False),
    _on("lockout_after", 5, "hikvision", password="wrong", refusals="credentials", table=False),
    # a server that means harm
    _on("garbage_every", 7, refusals=_NO_SENSE),
    _on("garbage_every", 1, "onvif", refusals=_NO_SENSE, table=False),
    _on("endless_body", refusals="bytes|needed more", table=False),
    _on("endless_body", True, "hikvision", refusals="bytes|needed more", table=False),
    _on("huge_length", refusals=f"{_NO_ANSWER}|bytes", table=False),
    _on("header_flood", refusals=_NO_SENSE, table=False),
    _on("slow_drip", refusals=f"{_NO_ANSWER}|needed more", table=False),
    _on("decompression_bomb", refusals="pixels", table=False),
    _on("redirect_to", "http://192.0.2.1/", refusals="30\\d|redirect", table=False),
    _on("billion_laughs", True, "onvif", refusals="XML|entit|forbidden", table=False),
    _on("billion_laughs", True, "hikvision", refusals="XML|entit|forbidden", table=False),
    # the dialect
    _on("wrong_host", dialect="onvif"),
    _on("clock_skew_s", 36000.0, "onvif"),
    _on("clock_skew_s", -36000.0, "onvif"),
    _on("local_time_as_utc", dialect="onvif"),
    _on("soap11", dialect="onvif"),
    _on("fault_status", 200, "onvif"),
    _on("fault_status", 400, "onvif"),
    _on("zoom_reset_by_pan_tilt", dialect="onvif"),
    # what the device says of itself
    _on("stuck_moving", dialect="sony_srg"),
    _on("stuck_moving", dialect="onvif"),
    _on("always_idle", dialect="onvif"),
    _on("no_position", True, "onvif", refusals="position", table=False),
    _on("frozen_position", True, "onvif", refusals=f"{_DEAF}|position", table=False),
    _on(
        "frozen_position", True, "hikvision", refusals=f"{_DEAF}|position", table=False, later=True
    ),
    _on("pan_reading_0_360", dialect="onvif"),
    # the head
    _on("head_stuck", refusals=_DEAF, table=False),
    _on("head_stuck", True, "axis", refusals=_DEAF, table=False, later=True),
    _on("ignore_move_every", 13),
    _on("ignore_move_every", 2, "hikvision"),
    _on("pan_reversed"),
    _on("tilt_reversed", dialect="hikvision"),
    _on(
        "pan_reversed",
        True,
        refusals="sign|against",
        table=False,
        config={"pan_sign": 1, "tilt_sign": 1},
        name="pan_reversed, pan_sign: 1",
    ),
    _on("backlash_first_step", 2.0),
    _on("overshoot_deg", 0.5, "axis"),
    _on("coast_deg", 0.3, "onvif", refusals=_ELSEWHERE),
    # a hundred times as much by the wall's clock, as all of the head's times
    _on("drift_deg_per_minute", 0.001, refusals=_UNTRUE),
    _on("drift_deg_per_minute", 0.01, refusals=_UNTRUE),
    _on("drift_deg_per_minute", 0.001, "axis", refusals=_UNTRUE),
    _on("drift_deg_per_minute", 0.01, "axis", refusals=_UNTRUE, table=False),
    _on("drift_deg_per_minute", 5.0, "axis", refusals=_UNTRUE, table=False),
    _on("zero_loss_deg", 1.0, refusals=_UNTRUE),
    _on("auto_flip", dialect="hikvision"),
    _on("return_home_s", 60.0, refusals=_STEERED),
    _on("second_operator_s", 90.0, refusals=_STEERED),
    _on("second_operator_s", 1500.0, refusals=_STEERED),
    # lens and picture
    _on("focus_hunting", dialect="axis"),
    _on("focus_hunting", dialect="sony_rz30"),
    _on("digital_zoom_hidden", True, "onvif", refusals="digital|zoom"),
    _on("eis_jitter_px", 3.0, "axis", refusals="come to rest|stabili"),
    _on("eis_jitter_px", 3.0, "sony_rz30", refusals="come to rest|stabili"),
    _on("osd"),
    _on("osd", dialect="hikvision"),
    _on("stale_frames", 1),
    _on("stale_frames", 3, "onvif"),
    _on("picture_rotation", 180),
    _on("picture_rotation", 90, refusals="turned|rotat", table=False),
    _on("picture_rotation", 270, "hikvision", refusals="turned|rotat", table=False),
    _on("mirrored", dialect="onvif"),
    _on("ball_hidden", refusals=_LOST, table=False),
    _on("ball_hidden", refusals=f"{_LOST}|where the scan", table=False, later=True),
    # what is no switch: a head too coarse, and pictures that pretend
    Case(
        {},
        "onvif",
        refusals="too coarse",
        name="three decimals in the generic space",
        simulated={"dialect_options": {"space": "generic", "decimals": 3}},
    ),
)
