"""What goes wrong with a simulated camera: the switches, on the wire and in the body."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from .settings import Count, NonNegativeFloat, Section


class FaultConfig(Section):
    """Every fault is off by default and may also be switched at run time.

    "Every Nth" counts what the switch is about and is 0 for never. Times of the head run on the
    head's clock, which `speed_up` hastens; those of the wire and of pictures, and what is said to
    be of the wall's clock, do not.
    """

    # the server
    refuse_connections: bool = False  # does not listen
    slow_reply_s: NonNegativeFloat = 0.0  # every reply waits so long
    busy_every: Count = 0  # every Nth request is answered 503
    double_cr: bool = False  # header lines end in CR CR LF
    truncated_jpeg_every: Count = 0  # every Nth picture ends half-way, its length not told
    truncated_jpeg_with_length_every: Count = 0  # the same, its whole length told
    one_shot_nonce: bool = False  # digest: every nonce serves one request
    connection_cap: Count = 0  # more connections than this in a second: 401, whatever the login
    lockout_after: Count = 0  # so many wrong logins: 401 to everything for a while

    # a server that means harm
    garbage_every: Count = 0  # every Nth reply is bytes without a meaning
    endless_body: bool = False
    huge_length: bool = False  # announces 1 GB, sends little, and keeps the connection
    header_flood: bool = False  # header lines without an end
    slow_drip: bool = False  # a byte now and then
    decompression_bomb: bool = False  # a small JPEG that claims to be huge
    redirect_to: str | None = None  # every reply sends the client to this address
    billion_laughs: bool = False  # XML replies whose entities expand without a bound

    # the dialect
    wrong_host: bool = False  # addresses in replies name a host where the device is not
    clock_skew_s: float = 0.0  # the device's clock less the true time
    local_time_as_utc: bool = False  # tells local time and calls it UTC
    soap11: bool = False  # envelopes of SOAP 1.1
    fault_status: Literal[0, 200, 400, 500] = 0  # HTTP status of SOAP faults; 0: the dialect's own
    zoom_reset_by_pan_tilt: bool = False  # a move without a zoom zooms out

    # what the device says of itself
    stuck_moving: bool = False  # claims to move, always
    always_idle: bool = False  # claims to rest, always
    no_position: bool = False  # has no position to tell
    frozen_position: bool = False  # tells the position of when this was switched on
    pan_reading_0_360: bool = False  # counts pan to the right from 0 to 360 degrees
    # It turns so much further than it is told and than it reads, but for an endless pan
    units_off_percent: Annotated[float, Field(gt=-50, lt=50)] = 0.0
    zoom_reading_offset_units: float = 0.0  # reads so many units of its own more

    # the head
    command_delay_s: NonNegativeFloat = 0.0  # carries out every command so much later, wall's clock
    head_stuck: bool = False  # accepts pan and tilt commands and does not move
    ignore_move_every: Count = 0  # accepts every Nth pan and tilt command and does not move
    pan_reversed: bool = False  # turns the other way than it reads
    tilt_reversed: bool = False
    backlash_first_step: NonNegativeFloat = 0.0  # quanta more in the first step after a reversal
    overshoot_deg: NonNegativeFloat = 0.0  # swings so much more after arrival, wall's clock
    coast_deg: NonNegativeFloat = 0.0  # stops up to so far beyond the target, and reads it
    drift_deg_per_minute: float = 0.0  # the truth leaves the reading, pan and tilt alike
    zero_loss_deg: NonNegativeFloat = 0.0  # the truth stays so much behind at every hard stop
    auto_flip: bool = False  # beyond 85 degrees down: pan turned by 180, picture upside down
    return_home_s: NonNegativeFloat = 0.0  # goes home when nobody has commanded it for so long
    second_operator_s: NonNegativeFloat = 0.0  # somebody else moves it so often

    # lens and picture
    zoom_backlash_units: NonNegativeFloat = 0.0  # stops up to so many units of the motor short of
    # what it reads when it comes from the long end
    picture_period_s: NonNegativeFloat = 0.0  # a new picture only so often, the same one meanwhile
    focus_hunting: bool = False  # while the focus is automatic the picture breathes and blurs
    digital_zoom_hidden: bool = False  # the last quarter of the "optical" range is a crop
    eis_jitter_px: NonNegativeFloat = 0.0  # one sigma; while the stabiliser is on
    osd: bool = False  # a clock in the picture; while the overlay is on
    stale_frames: Count = 0  # so many pictures after a command still show the view before it
    picture_rotation: Literal[0, 90, 180, 270] = 0  # clockwise
    mirrored: bool = False  # left and right exchanged, before it is rotated
    ball_hidden: bool = False
