"""The ONVIF driver against canned replies: what real firmware was seen to answer."""

import math
from functools import partial

import pytest

from tests.odd_onvif import (
    DEGREES,
    GENERIC,
    PROFILE,
    PTZ,
    UTC,
    ZOOM,
    OddDevice,
    fault,
    service,
    space,
    spaces,
    status,
    zoom_space,
)
from torchptz.cameras import AuthenticationError, Pose, ProtocolError


@pytest.fixture
def odd():
    device = OddDevice()
    yield device
    device.stop()


class TestPositions:
    def test_seen_status_outside_of_its_declared_range(self, odd):
        odd.answers["GetConfigurationOptions"] = spaces(
            space(GENERIC, (0, 1), (0, 1)), zoom_space()
        )
        odd.answers["GetStatus"] = status(
            f'space="{GENERIC}" y="0.267444015" x="-0.864665985"',
            f'space="{ZOOM}" x="0.211861998"',
            "<tt:MoveStatus><tt:PanTilt>IDLE</tt:PanTilt><tt:Zoom>IDLE</tt:Zoom></tt:MoveStatus>",
        )
        camera = odd.open()
        camera.connect()
        pose = camera.position()
        assert math.degrees(pose.pan) == pytest.approx(0.864665985 * 180)
        assert pose.zoom == 0.211861998
        assert camera.at_rest() is True
        assert camera.axes.pan.limits == (-1, 1)
        assert camera.capabilities.pan_quantum == 0  # nine decimals
        assert any("reads pan -0.864666, outside" in note for note in camera.notes)

    def test_limits_widen_under_way(self, odd):
        camera = odd.open()
        camera.connect()
        odd.answers["GetStatus"] = status(f'x="10.5" y="25" space="{DEGREES}"')
        assert math.degrees(camera.position().tilt) == pytest.approx(-25)
        assert camera.axes.tilt.limits == (-90, 25)
        assert any("tilt 25, outside" in note for note in camera.notes)

    def test_step_is_the_most_decimals_seen(self, odd):
        camera = odd.open()
        odd.answers["GetStatus"] = status(f'x="10.5" y="-5" space="{DEGREES}"')
        camera.connect()
        assert camera.capabilities.pan_quantum == pytest.approx(math.radians(0.1))
        odd.answers["GetStatus"] = status(f'x="10.5" y="-5.25" space="{DEGREES}"')
        camera.position()
        assert camera.capabilities.pan_quantum == pytest.approx(math.radians(0.01))

    def test_whole_degrees_are_a_step_only_after_a_command_beside_them(self, odd):
        odd.answers["GetStatus"] = status(f'x="0" y="0" space="{DEGREES}"')
        odd.answers["AbsoluteMove"] = ""
        camera = odd.open()
        camera.connect()
        assert camera.capabilities.pan_quantum == 0  # a printer that leaves zeros out says so too
        camera.move(Pose(math.radians(-3.4), math.radians(-5.0), 0.0))
        odd.answers["GetStatus"] = status(f'x="3" y="5" space="{DEGREES}"')
        camera.position()
        can = camera.capabilities
        assert (math.degrees(can.pan_quantum), can.tilt_quantum) == (pytest.approx(1.0), 0)

    def test_whole_numbers_say_nothing_of_a_generic_step(self, odd):
        odd.answers["GetConfigurationOptions"] = spaces(
            space(GENERIC, (-1, 1), (-1, 1)), zoom_space()
        )
        odd.answers["GetStatus"] = status(f'x="0" y="0" space="{GENERIC}"', 'x="0"')
        camera = odd.open()
        camera.connect()
        assert camera.capabilities.pan_quantum == 0

    def test_told_in_the_generic_space_beside_degrees(self, odd):
        odd.answers["GetConfigurationOptions"] = spaces(
            space(DEGREES, (-170, 170), (-90, 20)), space(GENERIC, (-1, 1), (-1, 1)), zoom_space()
        )
        odd.answers["GetStatus"] = status(f'x="0.5" y="1.0" space="{GENERIC}"')
        camera = odd.open()
        camera.connect()
        pose = camera.position()
        assert (math.degrees(pose.pan), math.degrees(pose.tilt)) == pytest.approx((-85, -20))
        assert camera.capabilities.scale_sigma == (0.01, 0.01)
        camera.move(Pose(math.radians(85), math.radians(90), 0.0))
        assert f'x="-0.500000" y="-1.000000" space="{GENERIC}"' in odd.sent("AbsoluteMove")[0]

    def test_all_axes_in_one_move(self, odd):
        camera = odd.open()
        camera.connect()
        camera.move(Pose(math.radians(-20), math.radians(30), 0.5))
        (move,) = odd.sent("AbsoluteMove")
        assert f'<tt:PanTilt x="20.000000" y="-30.000000" space="{DEGREES}"/>' in move
        assert f'<tt:Zoom x="0.500000" space="{ZOOM}"/>' in move

    def test_never_reads_another_space_for_its_own(self, odd):
        camera = odd.open()
        camera.connect()
        odd.answers["GetStatus"] = status(f'x="0.5" y="0.5" space="{GENERIC}"')
        with pytest.raises(ProtocolError, match="another space"):
            camera.position()

    def test_no_motion_flag(self, odd):
        odd.answers["GetStatus"] = status('x="1.5" y="2.5"', move="")
        camera = odd.open()
        camera.connect()
        assert not camera.capabilities.reports_motion
        camera.position()
        assert camera.at_rest() is None


class TestRefused:
    @pytest.mark.parametrize(
        ("operation", "answer", "message"),
        [
            ("GetConfigurationOptions", spaces(zoom_space()), "no absolute positions of pan"),
            (
                "GetConfigurationOptions",
                spaces(space(DEGREES, (-1, 1), (-1, 1))),
                "no absolute positions of zoom",
            ),
            ("GetProfiles", PROFILE.format("p", "P", ""), "none of them with pan and tilt"),
            ("GetServices", service("ver10/media", "/m"), "GetCapabilities.*ActionNotSupported"),
            (
                "GetStatus",
                f"<tptz:PTZStatus>{UTC}</tptz:PTZStatus>",
                "does not tell its position.*use a camera that tells",
            ),
            ("GetStatus", status('x="nan" y="0"'), "tells the position"),
            ("GetStatus", (400, fault("InvalidArgVal", "NoProfile")), "NoProfile.*option profile"),
            ("GetStatus", (500, "<s:Fault a=“curly”/>".encode()), "status 500"),
            ("GetProfiles", (200, b"<html>hello"), "no SOAP.*option path"),
            (
                "GetSnapshotUri",
                "<trt:MediaUri><tt:Uri>rtsp://1.2.3.4/live</tt:Uri></trt:MediaUri>",
                r"stream \(rtsp\).*option snapshot_path",
            ),
        ],
    )
    def test_with_the_reason_and_a_way_out(self, odd, operation, answer, message):
        odd.answers[operation] = answer
        with pytest.raises(ProtocolError, match=f"(?s)odd .*{message}"):
            odd.open().connect()

    @pytest.mark.parametrize(
        ("codes", "way_out"),
        [
            (("InvalidArgVal", "InvalidPosition"), "pan_range_deg and tilt_range_deg"),
            (("InvalidArgVal", "SpaceNotSupported"), "update its firmware"),
            (("Action", "ActionFailed"), "camera's own log"),
        ],
    )
    def test_moves(self, odd, codes, way_out):
        odd.answers["AbsoluteMove"] = (500, fault(*codes))
        camera = odd.open()
        camera.connect()
        with pytest.raises(ProtocolError, match=f"{codes[-1]}.*{way_out}"):
            camera.move(Pose(0.0, 0.0, 0.0))

    def test_login_that_was_good_and_is_no_more(self, odd):
        secured = dict.fromkeys(odd.answers)
        for operation, answer in odd.answers.items():

            def check(text, answer=answer):
                good = "UsernameToken" in text and not secured.get("changed")
                return answer if good else (400, fault("NotAuthorized"))

            odd.answers[operation] = check
        camera = odd.open()
        camera.connect()
        secured["changed"] = True
        before = len(odd.requests)
        for _ in range(3):
            with pytest.raises(AuthenticationError, match="accepted before"):
                camera.position()
        tokens = [text for _, _, text in odd.requests[before:] if "UsernameToken" in text]
        assert len(tokens) == 2

    def test_limit_of_connections_is_no_wrong_password(self, odd):
        answers, full = dict(odd.answers), []

        def check(operation, text):
            if full:
                full.pop()
                return 401, b"too many"
            return answers[operation] if "UsernameToken" in text else (400, fault("NotAuthorized"))

        for operation in answers:
            odd.answers[operation] = partial(check, operation)
        camera = odd.open()
        camera.connect()
        full.extend([True])
        camera.position()

    def test_account_without_the_right_to_one_thing(self, odd):
        def check(text, answer):
            return answer if "UsernameToken" in text else (400, fault("NotAuthorized"))

        for operation, answer in odd.answers.items():
            odd.answers[operation] = lambda text, answer=answer: check(text, answer)
        odd.answers["AbsoluteMove"] = (400, fault("NotAuthorized"))
        camera = odd.open()
        camera.connect()
        with pytest.raises(ProtocolError, match=r"AbsoluteMove.*give its account the right"):
            camera.move(Pose(0.0, 0.0, 0.0))
        camera.position()


class TestChoices:
    def test_older_device_without_get_services(self, odd):
        del odd.answers["GetServices"]
        odd.answers["GetCapabilities"] = (
            "<tds:Capabilities><tt:Media><tt:XAddr>http://{host}/old/m</tt:XAddr></tt:Media>"
            "<tt:PTZ><tt:XAddr>http://{host}/old/p</tt:XAddr></tt:PTZ></tds:Capabilities>"
        )
        camera = odd.open()
        camera.connect()
        assert {path for name, path, _ in odd.requests if name == "GetStatus"} == {"/old/p"}

    def test_first_profile_with_pan_and_tilt_unless_named(self, odd):
        odd.answers["GetProfiles"] = (
            PROFILE.format("0", "plain", "")
            + PROFILE.format("1", "one", PTZ)
            + PROFILE.format("2&amp;", "two", PTZ)
        )
        camera = odd.open()
        camera.connect()
        assert "<tptz:ProfileToken>1</tptz:ProfileToken>" in odd.sent("GetStatus")[0]
        camera = odd.open(profile="two")
        camera.connect()
        assert "<tptz:ProfileToken>2&amp;</tptz:ProfileToken>" in odd.sent("GetStatus")[-1]
        with pytest.raises(ProtocolError, match=r"no profile 'plain'.*'1', '2&'"):
            odd.open(profile="plain").connect()

    def test_spaces_of_the_node_where_the_configuration_has_none(self, odd):
        options = odd.answers.pop("GetConfigurationOptions")
        odd.answers["GetNodes"] = options
        camera = odd.open()
        camera.connect()
        assert camera.axes.pan.limits == (-170, 170)

    @pytest.mark.parametrize("keep", [False, True])
    def test_port_of_pictures(self, odd, keep):
        uri = "http://192.168.1.9:8899/snap?user=a&amp;n=1"
        odd.answers["GetSnapshotUri"] = f"<trt:MediaUri><tt:Uri>{uri}</tt:Uri></trt:MediaUri>"
        camera = odd.open(keep_ports=keep)
        camera.connect()
        port = "8899" if keep else odd.address.rpartition(":")[2]
        assert camera._pictures.address == f"127.0.0.1:{port}"
        assert camera._pictures._login is camera._transport._login  # one wrong password for both
        assert camera._picture_path == "/snap?user=a&n=1"
        assert any("192.168.1.9" in note for note in camera.notes)

    def test_path_of_pictures_given(self, odd):
        del odd.answers["GetSnapshotUri"]
        camera = odd.open(snapshot_path="/jpg")
        camera.connect()
        assert camera._picture_path == "/jpg"
