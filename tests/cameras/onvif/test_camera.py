"""The ONVIF driver against the simulated device, over real sockets."""

import math
import time

import pytest

from torchptz.cameras import AuthenticationError, Credentials, Pose, ProtocolError, open_camera
from torchptz.simulation import SimulatedFleet

PASSWORD = "s3cret:Pässword/77"


@pytest.fixture
def start():
    """start(options of the driver, **dialect options): driver, fleet and body of one device."""
    fleets, drivers = [], []

    def run(options=None, *, faults=None, password=PASSWORD, user="admin", **dialect_options):
        camera = {
            "name": "dome",
            "dialect": "onvif",
            "image_size": [160, 96],
            "password": PASSWORD,
            "user": user,
            "head": {"speed_up": 200},
            "scene": {"board": None},
            "dialect_options": dialect_options,
            "faults": faults or {},
        }
        fleet = SimulatedFleet({"cameras": [camera]}).start()
        fleets.append(fleet)
        credentials = Credentials("admin", password) if password else None
        address = fleet.addresses["dome"]
        drivers.append(
            open_camera("onvif", "dome", address, credentials, read_timeout_s=2, **(options or {}))
        )
        return drivers[-1], fleet, fleet.cameras["dome"]

    yield run
    for driver in drivers:
        driver.close()
    for fleet in fleets:
        fleet.stop()


def refusals(fleet):
    """How many logins of either kind the device refused."""
    server = fleet._servers["dome"]
    return server.login.rejected + server.dialect.rejected_logins


def arrive(driver, body, pan_deg, tilt_deg, zoom):
    """Moves there; the reading once the head stands still."""
    driver.move(Pose(math.radians(pan_deg), math.radians(tilt_deg), zoom))
    deadline = time.monotonic() + 5
    while body.head.moving() and time.monotonic() < deadline:
        time.sleep(0.005)
    return driver.position()


def degrees(pose):
    return math.degrees(pose.pan), math.degrees(pose.tilt)


class TestDegrees:
    def test_goes_where_it_is_sent_in_our_signs(self, start):
        driver, _, body = start()
        driver.connect()
        told = arrive(driver, body, 30.25, 12.5, driver.zoom_units(3))
        assert degrees(told) == pytest.approx((30.25, 12.5))
        assert degrees(body.head.true_pose()) == pytest.approx((30.25, 12.5))
        assert body.head.true_pose().zoom_units == pytest.approx(
            body.zoom_scale.to_body(told.zoom), abs=1
        )
        assert driver.snapshot().shape == (96, 160, 3)
        assert driver.at_rest() is True

    def test_what_it_can(self, start):
        driver, _, body = start({"horizontal_fov_deg": 58, "max_magnification": 18})
        driver.connect()
        can = driver.capabilities
        assert can.pan_circular
        assert can.tilt_limits == pytest.approx(body.tilt_limits)
        assert can.pan_quantum == pytest.approx(math.radians(0.01))  # two decimals are printed
        assert (can.scale_sigma, can.tilt_zero_sigma) == ((0, 0), 0)
        assert (can.zoom_limits, can.max_magnification) == ((0, 1), pytest.approx(18))
        assert can.reports_motion
        assert can.horizontal_fov == pytest.approx(math.radians(58))
        assert driver.identity.startswith("Simulated Dome ")

    def test_preferred_where_the_position_is_told_in_it(self, start):
        driver, *_ = start(space="both")
        driver.connect()
        assert driver.capabilities.scale_sigma == (0, 0)

    def test_pan_counted_from_0_to_360(self, start):
        driver, _, body = start(faults={"pan_reading_0_360": True})
        driver.connect()
        assert degrees(arrive(driver, body, 30, 10, 0)) == pytest.approx((30, 10))
        assert degrees(arrive(driver, body, -30, 10, 0)) == pytest.approx((-30, 10))
        assert not [note for note in driver.notes if "declared" in note]


class TestGeneric:
    def test_belief_is_said_and_uncertain(self, start):
        driver, _, body = start(space="generic", decimals=3)
        driver.connect()
        can = driver.capabilities
        assert can.scale_sigma == (0.05, 0.05)
        assert can.tilt_zero_sigma == pytest.approx(math.radians(5))
        assert can.tilt_limits == pytest.approx((-math.pi / 2, math.pi / 2))
        assert can.pan_quantum == pytest.approx(math.radians(0.18))
        assert any("pan_range_deg" in note for note in driver.notes)
        assert any("tilt_range_deg" in note for note in driver.notes)
        pan, _ = degrees(arrive(driver, body, 45, 20, 0.25))
        assert pan == pytest.approx(45)
        assert math.degrees(body.head.true_pose().pan) == pytest.approx(45, abs=0.006)

    def test_data_sheet_makes_it_exact(self, start):
        ranges = {"pan_range_deg": [-180, 180], "tilt_range_deg": [-90, 15]}
        driver, _, body = start(ranges, space="generic", decimals=6)
        driver.connect()
        told = arrive(driver, body, -70.3, 33.3, 0.5)
        assert degrees(told) == pytest.approx((-70.3, 33.3), abs=0.006)
        assert degrees(body.head.true_pose()) == pytest.approx(degrees(told), abs=1e-3)
        assert driver.capabilities.scale_sigma == (0.01, 0.01)
        assert driver.capabilities.pan_quantum == 0  # six decimals are no grid
        assert driver.capabilities.pan_circular

    def test_degrees_under_a_generic_name(self, start):
        driver, _, body = start(space="mislabelled")
        driver.connect()
        told = arrive(driver, body, 20, 30, 0)
        assert degrees(told) == pytest.approx((20, 30))
        assert degrees(body.head.true_pose()) == pytest.approx((20, 30))
        assert driver.capabilities.scale_sigma == (0.05, 0.05)
        assert any("believed to be 0 to 360 deg" in note for note in driver.notes)

    def test_older_device_does_not_tell_whether_it_moves(self, start):
        driver, *_ = start(profile_s=True)
        driver.connect()
        driver.position()
        assert driver.at_rest() is None
        assert not driver.capabilities.reports_motion


class TestLogin:
    @pytest.mark.parametrize("auth", ["either", "wsse", "digest", "both"])
    @pytest.mark.parametrize("skew_h", [-10, 0, 10])
    def test_every_way_at_every_clock(self, start, auth, skew_h):
        driver, fleet, _ = start(auth=auth, faults={"clock_skew_s": skew_h * 3600})
        driver.connect()
        driver.snapshot()
        assert refusals(fleet) == 0
        assert any("clock" in note for note in driver.notes) == bool(skew_h)

    def test_local_time_told_for_utc(self, start):
        driver, fleet, _ = start(auth="wsse", faults={"local_time_as_utc": True})
        driver.connect()
        driver.position()
        assert refusals(fleet) == 1

    @pytest.mark.parametrize(
        ("auth", "faults", "times"),
        [
            ("either", {}, 1),
            ("wsse", {}, 1),
            ("both", {}, 1),
            ("wsse", {"clock_skew_s": 36000}, 2),
            ("wsse", {"local_time_as_utc": True}, 2),
        ],
    )
    def test_wrong_password_is_tried_no_more_than(self, start, auth, faults, times):
        driver, fleet, _ = start(auth=auth, faults=faults, password="wrong")
        for _ in range(3):
            with pytest.raises(AuthenticationError, match=r"dome.*left alone"):
                driver.connect()
        assert refusals(fleet) == times

    @pytest.mark.parametrize("auth", ["either", "wsse"])
    def test_none_given(self, start, auth):
        driver, fleet, _ = start(auth=auth, password=None)
        with pytest.raises(AuthenticationError, match="none are given"):
            driver.connect()
        assert refusals(fleet) == 0

    def test_none_needed(self, start):
        driver, *_ = start(user=None, password=None)
        driver.connect()
        assert driver.snapshot().shape == (96, 160, 3)

    def test_clock_that_jumps_under_way(self, start):
        driver, fleet, body = start(auth="wsse")
        driver.connect()
        body.set_faults(clock_skew_s=7200.0)
        driver.position()
        assert refusals(fleet) == 1


class TestFaults:
    @pytest.mark.parametrize("status", [0, 200, 400, 500])
    @pytest.mark.parametrize("soap11", [False, True])
    def test_not_authorized_at_any_status(self, start, status, soap11):
        faults = {"fault_status": status, "soap11": soap11}
        driver, fleet, _ = start(auth="wsse", faults=faults)
        driver.connect()
        driver.position()
        assert refusals(fleet) == 0

    def test_addresses_of_another_host(self, start):
        driver, *_ = start(faults={"wrong_host": True})
        driver.connect()
        assert driver.snapshot().shape == (96, 160, 3)
        assert any("192.168.68.111" in note for note in driver.notes)

    def test_zoom_stays_on_devices_that_reset_it(self, start):
        driver, _, body = start(faults={"zoom_reset_by_pan_tilt": True})
        driver.connect()
        assert arrive(driver, body, 10, 10, 0.5).zoom == pytest.approx(0.5, abs=0.01)

    def test_no_position(self, start):
        driver, *_ = start(faults={"no_position": True})
        with pytest.raises(ProtocolError, match="does not tell its position"):
            driver.connect()

    def test_claims_of_motion_are_passed_on(self, start):
        driver, _, body = start(faults={"stuck_moving": True})
        driver.connect()
        assert driver.at_rest() is False
        body.set_faults(stuck_moving=False, always_idle=True)
        driver.move(Pose(1.0, 0.1, 0.0))
        driver.position()
        assert driver.at_rest() is True

    @pytest.mark.parametrize("fault", [{"billion_laughs": True}, {"garbage_every": 1}])
    def test_hostile_replies(self, start, fault):
        driver, *_ = start(faults=fault)
        with pytest.raises(ProtocolError, match="dome"):
            driver.connect()


class TestState:
    def test_prepare_locks_and_restore_puts_back(self, start):
        driver, _, body = start()
        driver.connect()
        driver.prepare()
        assert (body.focus.auto, body.stabiliser) == (False, False)
        driver.restore()
        assert (body.focus.auto, body.stabiliser) == (True, True)

    def test_focus_is_found_once_and_set_again(self, start):
        driver, _, body = start()
        driver.connect()
        driver.prepare()
        found = driver.focus_once()
        assert found == pytest.approx(body.focus.position / 9999, abs=1e-5)
        assert not body.focus.auto
        body.focus.position = 5
        driver.set_focus(found)
        assert body.focus.position / 9999 == pytest.approx(found, abs=1e-4)

    def test_without_an_imaging_service(self, start):
        driver, *_ = start(imaging=False)
        driver.connect()
        driver.prepare()
        assert any("no switch for its focus" in note for note in driver.notes)
        assert driver.focus_once() is None
        driver.restore()


@pytest.mark.parametrize(
    "options",
    [
        {"pan_sign": 2},
        {"pan_range_deg": [10, -10]},
        {"tilt_range_deg": [1, 2, 3]},
        {"max_magnification": 1},
        {"path": "onvif"},
        {"horizontal_fov_deg": 200},
    ],
)
def test_options_out_of_range(options):
    with pytest.raises(ValueError, match=f"dome: {next(iter(options))}"):
        open_camera("onvif", "dome", "127.0.0.1:1", **options)
