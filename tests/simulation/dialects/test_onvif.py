"""The simulated ONVIF device on the wire, asked with envelopes written by hand."""

import base64
import hashlib
import math
import re
import secrets
import time
from datetime import UTC, datetime, timedelta

import pytest
import requests
from requests.auth import HTTPDigestAuth

from torchptz.simulation import SimulatedFleet, SimulationError

SPACES = "http://www.onvif.org/ver10/tptz"
DEGREES = f"{SPACES}/PanTiltSpaces/SphericalPositionSpaceDegrees"
NAMES = (
    'xmlns:tds="http://www.onvif.org/ver10/device/wsdl" '
    'xmlns:trt="http://www.onvif.org/ver10/media/wsdl" '
    'xmlns:tptz="http://www.onvif.org/ver20/ptz/wsdl" '
    'xmlns:tt="http://www.onvif.org/ver10/schema"'
)
PROFILE = "<tptz:ProfileToken>Profile_1</tptz:ProfileToken>"
STATUS = f"<tptz:GetStatus>{PROFILE}</tptz:GetStatus>"
CLOCK = "<tds:GetSystemDateAndTime/>"


class Wire:
    """One device and how to ask it."""

    def __init__(self, faults=None, image_size=(160, 96), **dialect_options):
        camera = {
            "name": "dome",
            "dialect": "onvif",
            "image_size": image_size,
            "password": "secret",
            "head": {"speed_up": 200},
            "scene": {"board": None},
            "faults": faults or {},
            "dialect_options": {"auth": "wsse", **dialect_options},
        }
        self.fleet = SimulatedFleet({"cameras": [camera]}).start()
        self.body = self.fleet.cameras["dome"]
        self.url = f"http://{self.fleet.addresses['dome']}"

    def post(self, body, token="", auth=None):
        envelope = (
            '<s:Envelope xmlns:s="http://www.w3.org/2003/05/soap-envelope">'
            f"<s:Header>{token}</s:Header><s:Body {NAMES}>{body}</s:Body></s:Envelope>"
        )
        return requests.post(
            f"{self.url}/onvif/ptz_service",
            envelope.encode(),
            headers={"Content-Type": "application/soap+xml"},
            auth=auth,
            timeout=5,
        )

    def ask(self, body):
        return self.post(body, token())

    def move(self, pan_tilt=None, zoom=None, space=""):
        space = f'space="{space}"' if space else ""
        position = f'<tt:PanTilt x="{pan_tilt[0]}" y="{pan_tilt[1]}" {space}/>' if pan_tilt else ""
        position += "" if zoom is None else f'<tt:Zoom x="{zoom}"/>'
        reply = self.ask(
            f"<tptz:AbsoluteMove>{PROFILE}<tptz:Position>{position}</tptz:Position>"
            "</tptz:AbsoluteMove>"
        )
        deadline = time.monotonic() + 5
        while self.body.head.moving() and time.monotonic() < deadline:
            time.sleep(0.005)
        return reply


def token(password="secret", ahead_s=0.0, nonce=None):
    nonce = nonce or secrets.token_bytes(16)
    created = (datetime.now(UTC) + timedelta(seconds=ahead_s)).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    digest = hashlib.sha1(nonce + created.encode() + password.encode()).digest()
    digest, nonce = (base64.b64encode(raw).decode() for raw in (digest, nonce))
    return (
        "<Security><UsernameToken><Username>admin</Username>"
        f"<Password>{digest}</Password><Nonce>{nonce}</Nonce><Created>{created}</Created>"
        "</UsernameToken></Security>"
    )


@pytest.fixture
def wire():
    started = []

    def start(*args, **options):
        started.append(Wire(*args, **options))
        return started[-1]

    yield start
    for one in started:
        one.fleet.stop()


class TestLogin:
    def test_clock_is_open_and_nothing_else(self, wire):
        device = wire()
        assert device.post(CLOCK).status_code == 200
        refused = device.post(STATUS)
        assert refused.status_code == 400
        assert "ter:NotAuthorized" in refused.text

    @pytest.mark.parametrize(
        ("options", "good"),
        [({}, True), ({"ahead_s": 4}, True), ({"ahead_s": 7}, False), ({"ahead_s": -7}, False)],
    )
    def test_token_near_the_clock(self, wire, options, good):
        assert wire().post(STATUS, token(**options)).ok == good

    def test_clock_skew_moves_the_window(self, wire):
        device = wire({"clock_skew_s": 3600.0})
        assert not device.post(STATUS, token()).ok
        assert device.post(STATUS, token(ahead_s=3600)).ok

    def test_nonce_serves_once(self, wire):
        device = wire()
        nonce = secrets.token_bytes(16)
        assert device.post(STATUS, token(nonce=nonce)).ok
        assert not device.post(STATUS, token(nonce=nonce)).ok

    def test_lock_out_after_wrong_passwords(self, wire):
        device = wire({"lockout_after": 2})
        for _ in range(2):
            assert not device.post(STATUS, token("wrong")).ok
        assert not device.post(STATUS, token()).ok
        assert device.fleet._servers["dome"].dialect.rejected_logins == 2

    def test_wrong_tokens_and_wrong_digests_are_counted_together(self, wire):
        device = wire({"lockout_after": 2}, auth="either")
        assert not device.post(STATUS, token("wrong")).ok
        assert device.post(STATUS, auth=HTTPDigestAuth("admin", "wrong")).status_code == 401
        assert not device.post(STATUS, token()).ok
        assert not device.post(STATUS, auth=HTTPDigestAuth("admin", "secret")).ok

    @pytest.mark.parametrize(
        ("auth", "by_token", "by_digest", "by_both"),
        [
            ("either", 200, 200, 200),
            ("wsse", 200, 400, 200),
            ("digest", 401, 200, 200),
            ("both", 401, 400, 200),
        ],
    )
    def test_which_login_it_takes(self, wire, auth, by_token, by_digest, by_both):
        device, digest = wire(auth=auth), HTTPDigestAuth("admin", "secret")
        assert device.post(STATUS, token()).status_code == by_token
        assert device.post(STATUS, auth=digest).status_code == by_digest
        assert device.post(STATUS, token(), auth=digest).status_code == by_both

    def test_pictures_take_a_digest(self, wire):
        device = wire()
        url = f"{device.url}/onvif/snapshot"
        assert requests.get(url, timeout=5).status_code == 401
        picture = requests.get(url, auth=HTTPDigestAuth("admin", "secret"), timeout=5)
        assert picture.headers["Content-Type"] == "image/jpeg"
        assert picture.content[-2:] == b"\xff\xd9"


class TestMoves:
    def test_right_and_up_are_positive(self, wire):
        device = wire()
        assert device.move((20.5, 10), 0.5, DEGREES).ok
        pose = device.body.head.true_pose()
        assert (math.degrees(pose.pan), math.degrees(pose.tilt)) == pytest.approx((-20.5, -10))
        assert '<tt:PanTilt x="20.50" y="10.00"' in device.ask(STATUS).text
        assert '<tt:Zoom x="0.50"' in device.ask(STATUS).text

    def test_generic_space_over_its_ranges(self, wire):
        device = wire(space="generic", decimals=4, pan_range=(-170, 190), tilt_range=(-90, 10))
        assert device.move((0.5, 0.8), 0).ok
        pose = device.body.head.true_pose()
        assert (math.degrees(pose.pan), math.degrees(pose.tilt)) == pytest.approx((-100, 0))
        assert 'x="0.5000" y="0.8000"' in device.ask(STATUS).text

    def test_degrees_under_a_generic_name(self, wire):
        device = wire(space="mislabelled")
        assert device.move((350, 80), 0).ok
        pose = device.body.head.true_pose()
        assert (math.degrees(pose.pan), math.degrees(pose.tilt)) == pytest.approx((10, 10))
        assert 'x="350.00" y="80.00"' in device.ask(STATUS).text

    @pytest.mark.parametrize("fault", [False, True])
    def test_without_a_zoom(self, wire, fault):
        device = wire({"zoom_reset_by_pan_tilt": fault})
        device.move(zoom=0.5)
        device.move((5, 5))
        zoomed = device.body.head.true_pose().zoom_units
        assert zoomed == (0 if fault else device.body.zoom_scale.to_body(0.5))

    @pytest.mark.parametrize(
        ("target", "code"),
        [
            (((0, 20), 0), "InvalidPosition"),
            (((0, 0), 1.2), "InvalidPosition"),
            (((0, "nan"), 0), "InvalidPosition"),
            (((0, 0), 0, f"{SPACES}/PanTiltSpaces/PositionGenericSpace"), "SpaceNotSupported"),
            ((), "InvalidPosition"),
        ],
    )
    def test_refused_before_anything_moves(self, wire, target, code):
        device = wire()
        before = device.body.head.true_pose()
        reply = device.move(*target)
        assert reply.status_code == 500
        assert f"ter:{code}" in reply.text
        assert device.body.head.true_pose() == before

    def test_unknown_profile_and_operation(self, wire):
        device = wire()
        assert "ter:NoProfile" in device.ask(STATUS.replace("Profile_1", "x")).text
        assert "ter:ActionNotSupported" in device.ask("<tptz:GetPresetTours/>").text
        assert "ter:ActionNotSupported" in device.ask("<tptz:camera/>").text


class TestFaults:
    def test_soap_11(self, wire):
        reply = wire({"soap11": True}).ask("<tptz:GetPresetTours/>")
        assert "http://schemas.xmlsoap.org/soap/envelope/" in reply.text
        assert "<faultcode>ter:ActionNotSupported</faultcode>" in reply.text

    @pytest.mark.parametrize(("status", "given"), [(0, 400), (200, 200), (500, 500)])
    def test_status_of_faults(self, wire, status, given):
        assert wire({"fault_status": status}).post(STATUS).status_code == given

    def test_wrong_host(self, wire):
        reply = wire({"wrong_host": True}).ask("<tds:GetServices/>")
        assert set(re.findall(r"XAddr>http://([^/]+)/", reply.text)) == {"192.168.68.111"}

    def test_local_time_called_utc(self, wire):
        reply = wire({"local_time_as_utc": True}).post(CLOCK)
        hour = int(re.search(r"<tt:Hour>(\d+)", reply.text)[1])
        assert hour == (datetime.now(UTC) + timedelta(hours=2)).hour

    def test_no_position_and_older_device(self, wire):
        assert "tt:Position" not in wire({"no_position": True}).ask(STATUS).text
        older = wire(profile_s=True)
        assert "MoveStatus" not in older.ask(STATUS).text
        options = "<tptz:GetNodes/>"
        assert DEGREES not in older.ask(options).text

    def test_pan_from_0_to_360(self, wire):
        device = wire({"pan_reading_0_360": True})
        device.move((-20, 0), 0)
        assert '<tt:PanTilt x="340.00"' in device.ask(STATUS).text

    def test_options_that_there_are_not(self):
        with pytest.raises(SimulationError, match="dialect_options"):
            Wire(space="polar")
