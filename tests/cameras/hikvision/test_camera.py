import math
import time

import numpy as np
import pytest

from torchptz.cameras import (
    AuthenticationError,
    BadPicture,
    CameraError,
    Credentials,
    MotionError,
    Pose,
    ProtocolError,
    open_camera,
)
from torchptz.cameras.hikvision.camera import HikvisionCamera
from torchptz.simulation import SimulatedFleet

PTZ = "/ISAPI/PTZCtrl/channels/1"
CAPABILITIES = """<?xml version="1.0" encoding="UTF-8"?>
<PTZChanelCap version="2.0" xmlns="http://www.hikvision.com/ver20/XMLSchema">
<AbsolutePanTiltPositionSpace>
<XRange><Min>0</Min><Max>3600</Max></XRange><YRange><Min>-200</Min><Max>900</Max></YRange>
</AbsolutePanTiltPositionSpace>
<AbsoluteZoomPositionSpace><ZRange><Min>10</Min><Max>420</Max></ZRange></AbsoluteZoomPositionSpace>
<ContinuousZoomSpace><ZRange><Min>-100</Min><Max>100</Max></ZRange></ContinuousZoomSpace>
</PTZChanelCap>"""
STATUS = (
    '<PTZStatus version="2.0" xmlns="http://www.hikvision.com/ver20/XMLSchema"><AbsoluteHigh>'
    "<elevation>0</elevation><azimuth>450</azimuth><absoluteZoom>10</absoluteZoom>"
    "</AbsoluteHigh></PTZStatus>"
)
OVERLAYS = """<?xml version="1.0" encoding="UTF-8"?>
<VideoOverlay version="2.0" xmlns="http://www.hikvision.com/ver20/XMLSchema">
<normalizedScreenSize><normalizedScreenWidth>704</normalizedScreenWidth></normalizedScreenSize>
<TextOverlayList size="8"><TextOverlay><id>1</id><enabled>true</enabled></TextOverlay>
</TextOverlayList>
<DateTimeOverlay><enabled>false</enabled></DateTimeOverlay>
<PTZInfoOverlay>
  <enabled>true</enabled>
</PTZInfoOverlay>
</VideoOverlay>"""


def response(code, sub="ok"):
    return (
        '<?xml version="1.0"?><ResponseStatus version="1.0" xmlns="http://www.std-cgi.com/ver10/'
        f'XMLSchema"><requestURL>x</requestURL><statusCode>{code}</statusCode>'
        f"<statusString>words</statusString><subStatusCode>{sub}</subStatusCode></ResponseStatus>"
    )


class Dome:
    """Documents by path; answers to PUT are used up one by one, then all is well."""

    def __init__(self):
        self.documents = {f"{PTZ}/capabilities": CAPABILITIES, f"{PTZ}/status": STATUS}
        self.answers = []
        self.puts = []

    def answer(self, request, http_reply):
        if request.method == "PUT":
            self.puts.append((request.path, request.body.decode()))
            status, body = self.answers.pop(0) if self.answers else (200, response(1))
            return http_reply(status, body.encode())
        if request.path not in self.documents:
            return http_reply(403, response(4, "notSupport").encode())
        return http_reply(200, self.documents[request.path].encode())


@pytest.fixture
def dome():
    return Dome()


@pytest.fixture
def make(device, dome, http_reply):
    def start(**options):
        fake = device(lambda request: dome.answer(request, http_reply))
        return HikvisionCamera("gate", fake.address, focus_wait_s=0.01, **options)

    return start


@pytest.fixture
def camera(make):
    camera = make()
    camera.connect()
    return camera


def pose(pan_deg, tilt_deg, zoom=10.0):
    return Pose(math.radians(pan_deg), math.radians(tilt_deg), zoom)


class TestTranscripts:
    def test_what_it_says_of_itself(self, camera):
        head = camera.capabilities
        assert head.pan_circular
        np.testing.assert_allclose(np.degrees(head.tilt_limits), (-20, 90))  # 90 down
        assert math.degrees(head.pan_quantum) == pytest.approx(0.1)
        assert (head.zoom_limits, head.max_magnification) == ((10, 420), 42)
        assert "give max_magnification" in camera.notes[0]
        assert camera.axes.signs_known is False

    def test_move(self, camera, dome):
        camera.move(pose(-135, -15, 40))
        assert dome.puts == [
            (
                f"{PTZ}/absolute",
                '<?xml version="1.0" encoding="UTF-8"?>\n<PTZData><AbsoluteHigh>'
                "<elevation>-150</elevation><azimuth>1350</azimuth><absoluteZoom>40</absoluteZoom>"
                "</AbsoluteHigh></PTZData>",
            )
        ]

    @pytest.mark.parametrize(
        "namespace",
        [
            "http://www.hikvision.com/ver20/XMLSchema",
            "http://www.std-cgi.com/ver20/XMLSchema",
            "http://www.isapi.org/ver20/XMLSchema",
        ],
    )
    def test_position(self, camera, dome, namespace):
        document = STATUS.replace("http://www.hikvision.com/ver20/XMLSchema", namespace)
        dome.documents[f"{PTZ}/status"] = document
        read = camera.position()
        assert (math.degrees(read.pan), read.tilt, read.zoom) == (pytest.approx(-45), 0, 10)
        assert camera.at_rest() is None

    def test_precise_move(self, make, dome):
        camera = make(precise=True)
        camera.connect()
        camera.move(pose(-135.0123, 12.5, 33))
        path, body = dome.puts[0]
        assert path == f"{PTZ}/absoluteEx"
        assert "<elevation>12.500</elevation><azimuth>135.012</azimuth>" in body
        assert "<absoluteZoom>3.3</absoluteZoom>" in body
        assert math.degrees(camera.axes.pan.step) == pytest.approx(0.1)  # as it is read

    def test_the_other_spelling_and_a_cable(self, make, dome):
        text = CAPABILITIES.replace("PTZChanelCap", "PTZChannelCap")
        text = text.replace("<Min>0</Min><Max>3600</Max>", "<Min>-1700</Min><Max>1700</Max>")
        dome.documents[f"{PTZ}/capabilities"] = text
        camera = make(max_magnification=30)
        camera.connect()
        np.testing.assert_allclose(np.degrees(camera.capabilities.pan_limits), (-170, 170))
        assert camera.capabilities.max_magnification == 30
        assert camera.notes == []
        with pytest.raises(MotionError, match=r"pan 171.000 deg; ask for -170 to 170 deg"):
            camera.move(pose(171, 0))
        with pytest.raises(MotionError, match="zoom 421 units; ask for 10 to 420"):
            camera.move(pose(0, 0, 421))
        assert dome.puts == []

    def test_a_lens_found_beyond_the_optical_range_goes_back_there(self, make, dome):
        camera = make(max_magnification=30)
        camera.connect()
        assert (camera.capabilities.zoom_limits, camera.zoom_range) == ((10, 300), (10, 420))
        camera.move(pose(0, 0, 420))
        assert "<absoluteZoom>420</absoluteZoom>" in dome.puts[-1][1]

    @pytest.mark.parametrize(("pan_deg", "azimuth"), [(0, 0), (0.04, 0), (0.1, 3599), (-180, 1800)])
    def test_the_circle_closes(self, camera, dome, pan_deg, azimuth):
        camera.move(pose(pan_deg, 0))
        assert f"<azimuth>{azimuth}</azimuth>" in dome.puts[0][1]

    def test_identity_and_a_head_that_turns_away(self, make, dome):
        dome.documents["/ISAPI/System/deviceInfo"] = (
            "<DeviceInfo><model>DS-2DE</model><serialNumber>7</serialNumber></DeviceInfo>"
        )
        dome.documents[f"{PTZ}/parkaction"] = (
            "<ParkAction><enabled>true</enabled><Parktime>30</Parktime></ParkAction>"
        )
        camera = make(max_magnification=42)
        camera.connect()
        assert camera.identity == "DS-2DE 7"
        assert "after 30 s without commands: switch its park action off" in camera.notes[0]

    def test_another_channel(self, make):
        with pytest.raises(ProtocolError, match=r"channels/2/capabilities.*invalid operation"):
            make(channel=2).connect()


class TestRefusals:
    @pytest.mark.parametrize(
        ("path", "document", "cause"),
        [
            ("capabilities", "<PTZAbility/>", "calls its capabilities PTZAbility; take a camera"),
            ("capabilities", "<PTZChanelCap/>", "tells no AbsolutePanTiltPositionSpace"),
            (
                "capabilities",
                CAPABILITIES.replace("<Max>900</Max>", "<Max>-200</Max>"),
                "from -200 to -200",
            ),
            (
                "capabilities",
                CAPABILITIES.replace("<Max>420</Max>", "<Max>10</Max>"),
                "from 10 to 10; take a camera",
            ),
            ("capabilities", "<html><p>Log in</html>", "unreadable.*check that it is a Hikvision"),
            ("status", "<PTZStatus/>", "does not tell its position"),
            ("status", STATUS.replace("450", "left"), "does not tell its position"),
            ("status", f'<!DOCTYPE x [<!ENTITY a "1">]>{STATUS}', "document type"),
        ],
    )
    def test_devices_that_cannot_do_it(self, make, dome, path, document, cause):
        dome.documents[f"{PTZ}/{path}"] = document
        with pytest.raises(ProtocolError, match=cause):
            make().connect()

    def test_nothing_is_known_before_connect(self, make, dome):
        with pytest.raises(CameraError, match=r"call connect\(\)"):
            make().move(pose(0, 0))

    @pytest.mark.parametrize("options", [{"channel": 0}, {"precise": 1}, {"max_magnification": 1}])
    def test_senseless_options(self, make, options):
        with pytest.raises(ValueError, match=f"camera gate: {next(iter(options))}"):
            make(**options)

    def test_no_picture(self, device, http_reply):
        fake = device(lambda _: http_reply(404))
        with pytest.raises(BadPicture, match=r"channels/101/picture; check the option channel"):
            HikvisionCamera("gate", fake.address).snapshot()


class TestSwitches:
    def test_only_its_own_overlays_change(self, camera, dome):
        path = "/ISAPI/System/Video/inputs/channels/1/overlays"
        dome.documents[path] = OVERLAYS
        camera.prepare()
        off = OVERLAYS.replace("  <enabled>true", "  <enabled>false")
        assert dome.puts == [(path, off)]
        camera.restore()
        assert dome.puts[1:] == [(path, OVERLAYS)]

    def test_a_refused_switch_is_noted_and_not_undone(self, camera, dome):
        dome.documents["/ISAPI/Image/channels/1/EIS"] = "<EIS><enabled>true</enabled></EIS>"
        dome.answers = [(403, response(4))]
        camera.prepare()
        assert "image stabiliser cannot be switched from here: switch it off" in camera.notes[-1]
        camera.restore()
        assert len(dome.puts) == 1

    def test_a_camera_without_one_push_focuses_by_its_mode(self, camera, dome):
        path = "/ISAPI/Image/channels/1/focusConfiguration"
        dome.documents[path] = "<F><focusStyle>SEMIAUTOMATIC</focusStyle></F>"
        dome.answers = [(403, response(4))]
        assert camera.focus_once() is None
        assert [body[-30:] for _, body in dome.puts[1:]] == [
            "<focusStyle>AUTO</focusStyle></F>"[-30:],
            "<focusStyle>MANUAL</focusStyle></F>"[-30:],
        ]


class TestAgainstTheSimulator:
    @pytest.fixture
    def fleet(self):
        camera = {
            "name": "gate",
            "dialect": "hikvision",
            "password": "simulated",
            "image_size": (160, 120),
            "head": {"speed_up": 200},
            "scene": {"board": None},
        }
        with SimulatedFleet({"cameras": [camera]}) as running:
            yield running

    def open(self, fleet, password="simulated", **options):
        login = Credentials("admin", password)
        return open_camera(
            "hikvision", "gate", fleet.addresses["gate"], login, focus_wait_s=0.01, **options
        )

    @pytest.mark.parametrize("precise", [False, True])
    def test_arrives_and_reads_where_it_is(self, fleet, precise):
        camera, body, wanted = self.open(fleet, precise=precise), fleet.cameras["gate"], None
        camera.connect()
        for wanted in (pose(123.4, -7.7, 52), pose(-179.9, 45.3, 10)):
            camera.move(wanted)
            for _ in range(500):
                if not body.head.moving():
                    break
                time.sleep(0.01)
            read, true = camera.position(), body.head.true_pose()
            assert math.degrees(read.pan) == pytest.approx(math.degrees(wanted.pan), abs=0.051)
            assert math.degrees(read.tilt) == pytest.approx(math.degrees(wanted.tilt), abs=0.051)
            assert read.zoom == wanted.zoom
            assert math.remainder(true.pan - read.pan, 2 * math.pi) == pytest.approx(0, abs=1e-3)
            assert body.optics.magnification(true.zoom_units) == pytest.approx(
                camera.magnification(read.zoom), rel=0.01
            )
        assert camera.snapshot().shape == (120, 160, 3)

    def test_prepares_focuses_and_restores(self, fleet):
        camera, body = self.open(fleet), fleet.cameras["gate"]
        camera.connect()

        def state():
            return body.overlay, body.stabiliser, body.focus.auto

        camera.prepare()
        camera.focus_once()
        assert state() == (False, False, False)
        camera.restore()
        assert state() == (True, True, True)

    def test_faults_that_are_refused(self, fleet):
        camera = self.open(fleet)
        fleet.set_faults("gate", no_position=True)
        with pytest.raises(ProtocolError, match="does not tell its position"):
            camera.connect()
        fleet.set_faults("gate", no_position=False, billion_laughs=True)
        with pytest.raises(ProtocolError, match="document type"):
            camera.connect()

    def test_wrong_password_is_tried_once(self, fleet):
        camera = self.open(fleet, "wrong")
        for call in (camera.connect, camera.snapshot, camera.focus_once):
            with pytest.raises(AuthenticationError):
                call()
        assert fleet.rejected_logins("gate") == 1
