"""Every fault of the simulated cameras, and what may become of a camera that has it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from torchptz.simulation import Served

# Words of refusals, as regular expressions.
_DEAF = r"does not move|does not follow|view from before|did not move|nothing moves"
_ELSEWHERE = r"stopped elsewhere|where the scan began|still moving"
_STEERED = r"another user|moved \d+ times|did not come to rest|stopped elsewhere|where the scan"
_UNTRUE = r"where the scan began|did not come to rest|outliers|misfit|not be trusted"
_GONE = r"Connection refused"
_NO_SENSE = r"does not speak HTTP"
_WRONG_PASSWORD = r"refuses the credentials"
_TOO_MUCH = r"sends more than \d+ bytes"
_ENTITIES = r"document type, which is refused"
_TURNED = r"turned by -?\d+ deg"
_CROP = r"is digital|is a crop|digital section"
_UNSTEADY = r"did not come to rest|image stabiliser"
_FINGERPRINT = r"fingerprint: '([0-9A-F]{2}:){31}[0-9A-F]{2}'"
_NEVER = r"(?!)"
_LOST = r"feature (was|is) (lost|not)|no feature|not seen|not found|only \d+ of"


@dataclass(frozen=True)
class Case:
    """A fault on a camera of a dialect that can have it."""

    faults: dict[str, object]  # by their names in the simulator's FaultConfig
    dialect: str = "sony_rz30"
    refusals: str = _NEVER  # of what a refusal must speak; default: it must not be refused
    table: bool = True  # a table within its sigmas is a right outcome, too
    widens: bool = False  # its sigmas may be any; else, of what must not be refused, the usual ones
    simulated: dict[str, object] = field(default_factory=dict)  # changes of the simulated camera
    # changes of its configuration, or what gives them for a camera of the served fleet
    config: dict[str, object] | Callable[[Served, str], dict[str, object]] = field(
        default_factory=dict
    )
    later: bool = False  # switched on only when the first lines are scanned
    password: str | None = None  # a wrong one
    name: str = ""  # default: the fault's

    @property
    def must_not_matter(self) -> bool:
        """Whether a table as good as that of a healthy camera must come of it."""
        return self.refusals == _NEVER and not self.widens

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


# However fast the head is, a swing and a buffer of the wall's clock take their time.
_PATIENT = {"timing": {"settle_s": 0.15}}


def _pinned(served: Served, name: str) -> dict[str, object]:
    return {"tls": {"fingerprint": served.fingerprints[name]}}


CASES: tuple[Case, ...] = (
    # nothing wrong, in each dialect: first, for what must not matter is compared with these
    *(
        Case({}, dialect, name="nothing")
        for dialect in ("sony_rz30", "sony_named", "sony_srg", "axis", "onvif", "hikvision")
    ),
    # the server
    _on("refuse_connections", refusals=_GONE, table=False),
    _on("refuse_connections", refusals=_GONE, table=False, later=True),
    _on("slow_reply_s", 0.02),
    _on(
        "slow_reply_s",
        2.0,
        refusals=r"timing\.longest_s",
        table=False,
        config={"timing": {"longest_s": 60.0}},
    ),
    _on("busy_every", 9),
    _on("busy_every", 1, refusals=r"is busy \(503\)", table=False),
    _on("double_cr"),
    _on("truncated_jpeg_every", 5),
    _on("truncated_jpeg_every", 1, refusals="picture is cut off", table=False),
    _on("truncated_jpeg_with_length_every", 5),
    _on("one_shot_nonce", dialect="axis"),
    _on("one_shot_nonce", dialect="hikvision"),
    _on("connection_cap", 1, "axis", refusals="limit of connections", table=False),
    _on("connection_cap", 6, "axis", refusals="limit of connections", later=True),
    *(
        _on(
            *("lockout_after", 5, dialect),
            password="wrong",
            refusals=_WRONG_PASSWORD,
            table=False,
        )
        for dialect in ("sony_rz30", "axis", "onvif", "hikvision")
    ),
    Case(
        {},
        "axis",
        refusals="wants https",
        table=False,
        simulated={"tls": True},
        name="https, not configured",
    ),
    Case(
        {},
        "axis",
        refusals=_FINGERPRINT,
        table=False,
        simulated={"tls": True},
        config={"tls": {}},
        name="https, self-signed",
    ),
    Case(
        {},
        "axis",
        simulated={"tls": True},
        config=_pinned,
        name="https, self-signed and pinned",
    ),
    # a server that means harm
    _on("garbage_every", 7, refusals=_NO_SENSE),
    _on("garbage_every", 1, "onvif", refusals=_NO_SENSE, table=False),
    _on("endless_body", refusals=_TOO_MUCH, table=False),
    _on("endless_body", True, "hikvision", refusals=_TOO_MUCH, table=False),
    _on("huge_length", refusals="announces 1000000000", table=False),
    _on("header_flood", refusals="bytes of headers", table=False),
    _on("slow_drip", refusals=r"needed more than \d+ s", table=False),
    _on("decompression_bomb", refusals="65000 x 65000 pixels", table=False),
    _on("redirect_to", "http://192.0.2.1/", refusals=r"status 302.*192\.0\.2\.1", table=False),
    _on("billion_laughs", True, "onvif", refusals=_ENTITIES, table=False),
    _on("billion_laughs", True, "hikvision", refusals=_ENTITIES, table=False),
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
    _on("no_position", True, "onvif", refusals="does not tell its position", table=False),
    _on("frozen_position", True, "onvif", refusals=_DEAF, table=False),
    _on("frozen_position", True, "hikvision", refusals=_DEAF, table=False, later=True),
    _on("pan_reading_0_360", dialect="onvif"),
    *(
        _on("units_off_percent", 3.0, dialect, refusals=_UNTRUE)
        for dialect in ("sony_srg", "axis", "hikvision", "onvif")
    ),
    _on("zoom_reading_offset_units", 1.0, "axis"),
    # to the very end, where one unit more is beyond what the lens has; so few lines tell no
    # distortion there, of a healthy camera either
    _on(
        "zoom_reading_offset_units",
        1.0,
        refusals="distortion cannot be told",
        config={"zooms": [1, 25]},
    ),
    # the head
    _on("command_delay_s", 0.2),
    _on("command_delay_s", 0.2, "axis"),
    _on("head_stuck", refusals=_DEAF, table=False),
    _on("head_stuck", True, "axis", refusals=_DEAF, table=False, later=True),
    _on("ignore_move_every", 13),
    _on("ignore_move_every", 2, "hikvision"),
    _on("pan_reversed"),
    _on("tilt_reversed", dialect="hikvision"),
    _on(
        "pan_reversed",
        True,
        refusals="picture moves against the pan axis",
        table=False,
        config={"pan_sign": 1, "tilt_sign": 1},
        name="pan_reversed, pan_sign: 1",
    ),
    _on("backlash_first_step", 2.0, widens=True),
    _on("overshoot_deg", 0.5, "axis", config=_PATIENT),
    _on("overshoot_deg", 0.5, "sony_rz30", config=_PATIENT),
    _on("coast_deg", 0.3, "onvif", refusals=_ELSEWHERE),
    # a hundred times as much by the wall's clock, as all of the head's times
    _on("drift_deg_per_minute", 0.001, refusals=_UNTRUE),
    _on("drift_deg_per_minute", 0.01, refusals=_UNTRUE),
    _on("drift_deg_per_minute", 0.001, "axis", refusals=_UNTRUE),
    _on("drift_deg_per_minute", 0.01, "axis", refusals=_UNTRUE, table=False),
    _on("drift_deg_per_minute", 5.0, "axis", refusals=_UNTRUE, table=False),
    _on("drift_deg_per_minute", 0.01, refusals=_UNTRUE, later=True),
    _on("drift_deg_per_minute", 0.02, "axis", refusals=_UNTRUE, table=False, later=True),
    _on("zero_loss_deg", 1.0, refusals=_UNTRUE),
    _on("auto_flip", dialect="hikvision"),
    _on("return_home_s", 60.0, refusals=_STEERED),
    _on("second_operator_s", 90.0, refusals=_STEERED),
    _on("second_operator_s", 1500.0, refusals=_STEERED),
    _on("second_operator_s", 90.0, refusals=_STEERED, table=False, later=True),
    _on("second_operator_s", 1500.0, "axis", refusals=_STEERED, later=True),
    # lens and picture
    _on("zoom_backlash_units", 20.0),
    _on("zoom_backlash_units", 20.0, "onvif"),
    _on("picture_period_s", 0.3, config=_PATIENT),
    _on("picture_period_s", 0.3, "onvif", config=_PATIENT),
    _on("focus_hunting", dialect="axis"),
    _on("focus_hunting", dialect="sony_rz30"),
    _on("digital_zoom_hidden", True, "onvif", refusals=_CROP),
    _on("eis_jitter_px", 3.0, "axis", refusals=_UNSTEADY),
    _on("eis_jitter_px", 3.0, "sony_rz30", refusals=_UNSTEADY),
    _on("osd"),
    _on("osd", dialect="hikvision"),
    _on("stale_frames", 1),
    _on("stale_frames", 3, "onvif"),
    _on("picture_rotation", 180),
    _on("picture_rotation", 90, refusals=_TURNED, table=False),
    _on("picture_rotation", 270, "hikvision", refusals=_TURNED, table=False),
    _on("mirrored", dialect="onvif"),
    _on("ball_hidden", refusals=_LOST, table=False),
    _on("ball_hidden", refusals=f"{_LOST}|where the scan", table=False, later=True),
    # what is no switch: a head too coarse, and pictures that pretend
    Case(
        {},
        "onvif",
        refusals="too coarse",
        name="three decimals in the generic space",
        table=False,
        simulated={"dialect_options": {"space": "generic", "decimals": 3}},
        config={"zooms": [1, 8, 16]},
    ),
)
