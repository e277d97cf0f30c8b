"""VAPIX as the simulated Axis camera speaks it, over real sockets."""

import re
import time
from math import degrees, pi, radians

import cv2
import numpy as np
import pytest
import requests
from requests.auth import HTTPDigestAuth

from torchptz.simulation import SimulatedFleet, SimulationError

CAMERA = {
    "name": "dome",
    "dialect": "axis",
    "password": "secret",
    "seed": 3,
    "image_size": [320, 180],
    "noise_dn": 0,
    "scene": {"board": None},
    "head": {"speed_up": 100},
}
PTZ, PARAMETERS = "/axis-cgi/com/ptz.cgi", "/axis-cgi/param.cgi"
PICTURE = "/axis-cgi/jpg/image.cgi"


class Outsider:
    """A client with a digest login; `get` and `post` give a reply, `told` its pairs."""

    def __init__(self, fleet):
        self.fleet, self.camera = fleet, fleet.cameras["dome"]
        self.url = f"http://{fleet.addresses['dome']}"
        self.auth = HTTPDigestAuth("admin", "secret")

    def get(self, path, **asked):
        return requests.get(self.url + path, params=asked, auth=self.auth, timeout=5)

    def post(self, path, body, kind):
        headers = {"Content-Type": kind}
        return requests.post(self.url + path, data=body, auth=self.auth, headers=headers, timeout=5)

    def told(self, **asked):
        return dict(line.split("=", 1) for line in self.get(PTZ, **asked).text.split())

    def settle(self):
        for _ in range(500):
            if not self.camera.head.moving():
                return
            time.sleep(0.01)
        raise AssertionError("still moving")

    def picture(self, **asked):
        reply = self.get(PICTURE, **asked)
        assert (reply.status_code, reply.headers["Content-Type"]) == (200, "image/jpeg")
        return cv2.imdecode(np.frombuffer(reply.content, np.uint8), cv2.IMREAD_COLOR)


@pytest.fixture
def outsider():
    """outsider(**settings): a client of a simulated camera of its own."""
    fleets = []

    def start(**settings):
        fleet = SimulatedFleet({"cameras": [{**CAMERA, **settings}]})
        fleet.start()
        fleets.append(fleet)
        return Outsider(fleet)

    yield start
    for fleet in fleets:
        fleet.stop()


class TestLogin:
    def test_digest_with_the_serial_number_in_its_realm(self, outsider):
        client = outsider()
        reply = requests.get(client.url + PTZ, timeout=5)
        challenge = reply.headers["WWW-Authenticate"]
        assert reply.status_code == 401
        assert re.match(r'Digest realm="AXIS_ACCC8E[0-9A-F]{6}"', challenge)
        assert 'qop="auth"' in challenge
        serial = client.get(PARAMETERS, action="list", group="root.Properties.System").text
        assert serial.strip().rpartition("=")[2] in challenge


class TestQueries:
    def test_position_in_the_order_and_precision_of_a_real_unit(self, outsider):
        client = outsider()
        assert client.get(PTZ, pan=51.289, tilt=46.19, zoom=250).status_code == 204
        client.settle()
        reply = client.get(PTZ, query="position")
        assert (reply.status_code, reply.headers["Content-Type"]) == (200, "text/plain")
        assert reply.raw.version == 11
        lines = reply.text.splitlines()
        assert lines[:3] == ["pan=51.2891", "tilt=46.1914", "zoom=250"]
        keys = [line.partition("=")[0] for line in lines[3:]]
        assert keys == ["iris", "focus", "brightness", "autofocus", "autoiris"]
        true = client.camera.head.true_pose()  # we count to the left and down
        assert degrees(true.pan) == pytest.approx(-51.2891, abs=1e-4)
        assert degrees(true.tilt) == pytest.approx(-46.1914, abs=1e-4)

    def test_limits_are_those_of_the_body(self, outsider):
        client = outsider(digital_zoom=False)
        told = client.told(query="limits")
        assert (told["MinPan"], told["MaxPan"]) == ("-170", "170")
        assert (told["MinTilt"], told["MaxTilt"]) == ("-20", "90")
        assert (told["MinZoom"], told["MaxZoom"]) == ("1", "9999")
        assert int(told["MaxFieldAngle"]) == round(10 * degrees(client.camera.horizontal_fov(0)))
        assert float(told["MinFieldAngle"]) < float(told["MaxFieldAngle"]) / 20

    def test_the_rest(self, outsider):
        client = outsider()
        assert client.told(query="speed") == {"speed": "100"}
        assert client.told(query="mode") == {"mode": "normal"}
        presets = client.get(PTZ, query="presetposall").text.splitlines()
        assert presets == ["Preset Positions for camera 1", "presetposno1=Home"]
        assert client.get(PTZ, whoami=1).text.strip() == "Sony_camblock"
        assert "query={" in client.get(PTZ, info=1).text
        assert {"pan", "MaxPan"} <= client.told(query="position,limits").keys()

    @pytest.mark.parametrize(
        ("asked", "words"),
        [
            ({"query": "foo"}, "query: unknown value: foo"),
            ({"pan": "east"}, "pan: invalid value: east"),
            ({"zoom": "nan"}, "zoom: invalid value: nan"),
            ({"move": "round"}, "move: unknown value: round"),
            ({"autofocus": "1"}, "autofocus: unknown value: 1"),
        ],
    )
    def test_errors_are_words_in_a_good_reply(self, outsider, asked, words):
        reply = outsider().get(PTZ, **asked)
        assert (reply.status_code, reply.text) == (200, f"Error:\r\n{words}\r\n")


class TestCommands:
    def test_relative_clipped_and_unknown_keys(self, outsider):
        client = outsider(digital_zoom=False)
        client.get(PTZ, pan=10, tilt=-5, zoom=500, html="no", timestamp=1, camera=1)
        client.settle()
        client.get(PTZ, rpan=-2.5, rtilt=1.25, rzoom=100)
        client.settle()
        told = client.told(query="position")
        assert [told[k] for k in ("pan", "tilt", "zoom")] == ["7.5000", "-3.7500", "600"]
        client.get(PTZ, pan=180, tilt=-180, zoom=19999)
        client.settle()
        told = client.told(query="position")
        assert [told[k] for k in ("pan", "tilt", "zoom")] == ["170.0000", "-20.0000", "9999"]

    @pytest.mark.parametrize("kind", ["application/x-www-form-urlencoded", "text/plain"])
    def test_posted_form(self, outsider, kind):
        client = outsider()
        assert client.post(PTZ, "pan=-12.5&speed=40", kind).status_code == 204
        client.settle()
        assert client.told(query="position")["pan"] == "-12.5000"
        assert client.told(query="speed") == {"speed": "40"}

    def test_an_axis_keeps_its_goal_while_the_other_is_sent_off(self, outsider):
        client = outsider(head={"speed_up": 5})
        client.get(PTZ, pan=60)
        client.get(PTZ, tilt=30)
        client.settle()
        told = client.told(query="position")
        assert (told["pan"], told["tilt"]) == ("60.0000", "30.0000")

    def test_until_stopped_home_and_by_the_picture(self, outsider):
        client = outsider(head={"speed_up": 4})
        client.get(PTZ, continuouspantiltmove="100,0")
        time.sleep(0.1)
        client.get(PTZ, continuouspantiltmove="0,0")
        client.settle()
        told = client.told(query="position")
        assert 5 < float(told["pan"]) < 169
        assert told["tilt"] == "0.0000"
        client.get(PTZ, move="left")
        client.settle()
        step = float(told["pan"]) - float(client.told(query="position")["pan"])
        assert step == pytest.approx(degrees(client.camera.horizontal_fov(0)) / 4, abs=1 / 256)
        client.get(PTZ, move="home")
        client.settle()
        assert client.told(query="position")["pan"] == "0.0000"

    def test_zoom_is_the_motors_travel_and_then_digital(self, outsider):
        client = outsider()
        for zoom, share in ((1, 0), (5000, 0.5), (9999, 1)):
            client.get(PTZ, zoom=zoom)
            client.settle()
            units = client.camera.head.true_pose().zoom_units
            assert units == pytest.approx(share * 16384, abs=1)
        client.get(PTZ, zoom=19999)
        client.settle()
        assert client.camera.head.true_pose().zoom_units > 16384

    def test_focus(self, outsider):
        client = outsider()
        client.get(PTZ, focus=5000)
        told = client.told(query="position")
        assert (told["focus"], told["autofocus"]) == ("5000", "off")
        client.get(PTZ, autofocus="on")
        assert client.told(query="position")["autofocus"] == "on"

    def test_a_turn_that_zooms_out(self, outsider):
        client = outsider(faults={"zoom_reset_by_pan_tilt": True})
        client.get(PTZ, zoom=4000)
        client.settle()
        client.get(PTZ, pan=20)
        client.settle()
        assert client.told(query="position")["zoom"] == "1"
        client.get(PTZ, pan=30, zoom=4000)
        client.settle()
        client.get(PTZ, autofocus="on")
        client.settle()
        assert client.told(query="position")["zoom"] == "4000"


class TestParameters:
    def test_groups(self, outsider):
        client = outsider()
        text = client.get(PARAMETERS, action="list", group="root.Brand,PTZ.Support.S1.AbsolutePan")
        lines = text.text.splitlines()
        assert "root.Brand.ProdNbr=V5915" in lines
        assert lines[-1] == "root.PTZ.Support.S1.AbsolutePan=true"
        assert all(line.startswith(("root.Brand.", "root.PTZ.Support.S1.")) for line in lines)
        absent = client.get(PARAMETERS, action="list", group="PTZ.Supp")
        assert absent.text == "# Error: Error -1 getting param in group 'root.PTZ.Supp'\n"
        limits = client.get(PARAMETERS, action="list", group="root.PTZ.Limit").text
        assert "root.PTZ.Limit.L1.MaxTilt=90\n" in limits

    def test_updates(self, outsider):
        client = outsider()
        returning = "root.PTZ.Various.V1.ReturnToOverview"
        stabiliser = "ImageSource.I0.Sensor.Stabilizer"
        assert client.get(PARAMETERS, action="update", **{returning: 30}).text == "OK\n"
        assert client.camera.faults.return_home_s == 30
        assert client.get(PARAMETERS, action="update", **{stabiliser: "off"}).text == "OK\n"
        assert not client.camera.stabiliser
        for name, value in ((stabiliser, "maybe"), ("Brand.ProdNbr", "X")):
            reply = client.get(PARAMETERS, action="update", **{name: value})
            assert reply.status_code == 200
            assert reply.text.lower() == (
                f"# error: error setting 'root.{name}' to '{value}'!\n".lower()
            )

    @pytest.mark.parametrize("options", [{"kind": "dome"}, {"rotation": 45}, {"colour": 1}])
    def test_options_of_the_dialect(self, outsider, options):
        with pytest.raises(SimulationError, match="dialect_options"):
            outsider(dialect_options=options)


class TestPictures:
    def test_sizes(self, outsider):
        client = outsider()
        assert client.picture().shape == (180, 320, 3)
        small, large = client.picture(resolution="160x90"), client.picture(resolution="320x180")
        halved = cv2.resize(large, (160, 90), interpolation=cv2.INTER_AREA)
        assert np.abs(small.astype(float) - halved).mean() < 3
        for asked in ({"resolution": "640x480"}, {"rotation": 45}, {"camera": 2}):
            assert client.get(PICTURE, **asked).status_code == 400

    def test_turned_as_set_up_or_as_asked(self, outsider):
        client = outsider(dialect_options={"rotation": 180})
        upright = client.picture(rotation=0).astype(float)
        assert np.abs(upright - client.picture()[::-1, ::-1]).mean() < 3
        quarter = client.picture(rotation=90)
        assert np.abs(np.rot90(upright, -1) - quarter).mean() < 3  # clockwise

    def test_text_is_left_out_where_asked(self, outsider):
        client = outsider(faults={"osd": True})
        plain = client.picture(text=0, clock=0, date=0).astype(float)
        client.camera.overlay = False
        clean = client.camera.render(client.camera.head.true_pose())
        client.camera.overlay = True
        assert np.abs(plain - clean).max() < 60
        assert np.abs(client.picture() - plain).max() > 100


def test_pan_without_an_end():
    head = {"pan_circular": True, "pan_limits_deg": [-180, 180], "speed_up": 100}
    with SimulatedFleet({"cameras": [{**CAMERA, "head": head}]}) as fleet:
        client = Outsider(fleet)
        assert client.told(query="limits")["MaxPan"] == "180"
        client.get(PTZ, pan=-175)
        client.settle()
        client.get(PTZ, pan=175)
        client.settle()
        true = client.camera.head.true_pose().pan
        assert (true + radians(175) + pi) % (2 * pi) - pi == pytest.approx(0, abs=1e-4)
