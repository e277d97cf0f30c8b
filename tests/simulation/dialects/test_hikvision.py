"""ISAPI's documents as clients of real domes write and read them."""

from math import degrees
from xml.etree import ElementTree

import pytest

from torchptz.simulation.dialects.hikvision import HikvisionIsapi
from torchptz.simulation.server import Request

ABSOLUTE = (
    '<?xml version="1.0" encoding="UTF-8"?>\n<PTZData><AbsoluteHigh><elevation>{}</elevation>'
    "<azimuth>{}</azimuth><absoluteZoom>{}</absoluteZoom></AbsoluteHigh></PTZData>"
)
PRECISE = (
    "<PTZAbsoluteEx version='2.0' xmlns='http://www.std-cgi.com/ver20/XMLSchema'>"
    "<elevation>{}</elevation><azimuth>{}</azimuth><absoluteZoom>{}</absoluteZoom>"
    "<horizontalSpeed>80</horizontalSpeed><verticalSpeed>80</verticalSpeed></PTZAbsoluteEx>"
)
PTZ = "/ISAPI/PTZCtrl/channels/1"


@pytest.fixture
def dome(make_camera):
    return HikvisionIsapi(
        make_camera(dialect="hikvision", image_size=(160, 120), head={"speed_up": 1000})
    )


def put(device, path, body=""):
    """HTTP status and the code in the ResponseStatus."""
    reply = device.answer(Request("PUT", path, body=body.encode()))
    return reply.status, int(texts(reply)["statusCode"])


def texts(reply):
    """The texts of a document by the local names of their elements."""
    elements = ElementTree.fromstring(reply.body).iter()
    return {element.tag.partition("}")[2]: (element.text or "") for element in elements}


def get(device, path):
    reply = device.answer(Request("GET", path))
    assert (reply.status, reply.content_type) == (200, "application/xml")
    return texts(reply)


def where(device):
    told = get(device, f"{PTZ}/status")
    return tuple(int(told[name]) for name in ("elevation", "azimuth", "absoluteZoom"))


def goes_to(device, clock, *numbers, path="absolute", body=ABSOLUTE):
    answer = put(device, f"{PTZ}/{path}", body.format(*numbers))
    clock.advance(1)
    return answer


class TestPositions:
    def test_absolute_and_status(self, dome, clock):
        assert goes_to(dome, clock, 450, 1350, 40) == (200, 1)
        assert where(dome) == (450, 1350, 40)
        pose = dome.camera.reading()
        assert degrees(pose.tilt) == pytest.approx(45)  # downward
        assert (degrees(pose.pan) + 180) % 360 - 180 == pytest.approx(-135)  # to the right
        assert dome.camera.optics.magnification(pose.zoom_units) == pytest.approx(4, rel=1e-3)

    @pytest.mark.parametrize("azimuth", [0, 1, 1799, 1800, 3599])
    def test_the_whole_circle(self, dome, clock, azimuth):
        goes_to(dome, clock, 0, azimuth, 10)
        assert where(dome) == (0, azimuth, 10)

    def test_a_whole_turn_is_where_it_began(self, dome, clock):
        assert goes_to(dome, clock, 0, 3600, 10) == (200, 1)
        assert where(dome) == (0, 0, 10)

    def test_precise_positions_are_degrees(self, make_camera, clock):
        fine = make_camera(
            dialect="hikvision",
            image_size=(160, 120),
            head={"speed_up": 1000, "pan_units_per_deg": 100, "tilt_units_per_deg": 100},
        )
        dome = HikvisionIsapi(fine)
        numbers = (12.53, 135.01, 1.0)
        assert goes_to(dome, clock, *numbers, path="absoluteEx", body=PRECISE) == (200, 1)
        assert where(dome) == (125, 1350, 10)  # read in tenths all the same
        assert degrees(fine.reading().tilt) == pytest.approx(12.53)

    def test_capabilities_are_those_of_the_head(self, make_camera):
        head = {"pan_circular": False, "pan_limits_deg": (-100, 90), "tilt_limits_deg": (-20, 90)}
        camera = make_camera(dialect="hikvision", image_size=(160, 120), head=head)
        reply = HikvisionIsapi(camera).answer(Request("GET", f"{PTZ}/capabilities"))
        root = ElementTree.fromstring(reply.body)
        assert root.tag.endswith("}PTZChanelCap")
        numbers = [int(e.text) for e in root.iter() if e.tag.endswith(("}Min", "}Max"))]
        assert numbers == [-900, 1000, -200, 900, 10, 250]

    def test_identity(self, dome):
        assert get(dome, "/ISAPI/System/deviceInfo")["model"] == "DS-2DE7A245IX"


class TestErrors:
    @pytest.mark.parametrize("numbers", [(901, 0, 10), (0, 3601, 10), (0, 0, 251), (0, -1, 10)])
    def test_out_of_range_and_then_deaf_once(self, dome, clock, numbers):
        assert goes_to(dome, clock, *numbers) == (403, 3)
        assert goes_to(dome, clock, 100, 200, 30) == (200, 1)
        assert where(dome) == (0, 0, 10)
        assert goes_to(dome, clock, 100, 200, 30) == (200, 1)
        assert where(dome) == (100, 200, 30)

    @pytest.mark.parametrize(
        ("path", "body", "answer"),
        [
            ("absolute", "<PTZData>", (400, 5)),
            ("absolute", "<PTZData/>", (400, 6)),
            ("absolute", ABSOLUTE.format("up", 0, 10), (400, 6)),
            ("absolute", ABSOLUTE.format(1.5, 0, 10), (400, 6)),
            ("absoluteEx", PRECISE.format("", 0, 10), (400, 6)),
            ("patrols/1/start", "", (403, 4)),
        ],
    )
    def test_in_their_own_words(self, dome, path, body, answer):
        assert put(dome, f"{PTZ}/{path}", body) == answer
        assert not dome.camera.moving()

    def test_another_channel(self, dome):
        assert put(dome, "/ISAPI/PTZCtrl/channels/2/absolute", ABSOLUTE.format(0, 0, 10))[1] == 4

    def test_status_of_faults(self, dome):
        dome.camera.set_faults(fault_status=200)
        assert put(dome, f"{PTZ}/absolute", ABSOLUTE.format(901, 0, 10)) == (200, 3)

    def test_no_position(self, dome):
        dome.camera.set_faults(no_position=True)
        assert "azimuth" not in get(dome, f"{PTZ}/status")


class TestSwitches:
    def test_overlays_one_by_one(self, dome):
        path = "/ISAPI/System/Video/inputs/channels/1/overlays"
        for name, left in (("PTZInfoOverlay", True), ("DateTimeOverlay", True)):
            body = f"<VideoOverlay><{name}><enabled>false</enabled></{name}></VideoOverlay>"
            assert put(dome, path, body) == (200, 1)
            assert dome.camera.overlay is left
        whole = dome.answer(Request("GET", path)).body.decode().replace("true", "false")
        assert put(dome, path, whole) == (200, 1)
        assert dome.camera.overlay is False

    def test_focus(self, dome):
        path = "/ISAPI/Image/channels/1/focusConfiguration"
        assert get(dome, path)["focusStyle"] == "SEMIAUTOMATIC"
        body = "<FocusConfiguration><focusStyle>MANUAL</focusStyle></FocusConfiguration>"
        assert put(dome, path, body) == (200, 1)
        assert get(dome, path)["focusStyle"] == "MANUAL"
        dome.camera.focus.position = 7
        assert put(dome, f"{PTZ}/onepushfoucs/start") == (200, 1)
        assert (dome.camera.focus.position, dome.camera.focus.auto) == (1000, False)

    def test_stabiliser(self, dome):
        path = "/ISAPI/Image/channels/1/EIS"
        assert put(dome, path, "<EIS><enabled>false</enabled></EIS>") == (200, 1)
        assert dome.camera.stabiliser is False
        assert get(dome, path)["enabled"] == "false"
        assert put(dome, path, "<EIS><enabled>no</enabled></EIS>") == (400, 6)

    def test_tells_that_it_turns_home(self, dome):
        assert get(dome, f"{PTZ}/parkaction")["enabled"] == "false"
        dome.camera.set_faults(return_home_s=30)
        assert get(dome, f"{PTZ}/parkaction")["Parktime"] == "30"


def test_picture(dome):
    reply = dome.answer(Request("GET", "/ISAPI/Streaming/channels/101/picture"))
    assert reply.body[:2] + reply.body[-2:] == b"\xff\xd8\xff\xd9"
