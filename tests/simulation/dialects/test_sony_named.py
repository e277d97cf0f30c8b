"""Sony's named parameters: the exchanges that are known, byte for byte where it matters."""

from math import degrees, radians

import pytest

from torchptz.simulation.dialects.sony_named import SonyNamed, SonySrg
from torchptz.simulation.server import Request

SRG_PTZF = (
    "AbsolutePTZF=15400,fd578,0000,FOCUS&PanMovementRange=eac00,15400&PanPanoramaRange=de00,2200"
    "&PanTiltMaxVelocity=24&PtzInstance=1&TiltMovementRange=fc400,b400&TiltPanoramaRange=fc00,1200"
    "&ZoomMaxVelocity=8&ZoomMovementRange=0000,4000,7ac0&PtzfStatus=idle,idle,idle,idle"
    "&AbsoluteZoom=609"
)


@pytest.fixture
def srg(make_camera):
    return SonySrg(make_camera(dialect="sony_srg", image_size=(160, 120), head={"speed_up": 1000}))


@pytest.fixture
def rx(make_camera):
    return SonyNamed(
        make_camera(dialect="sony_named", image_size=(160, 120), head={"speed_up": 1000})
    )


def get(device, path, **parameters):
    return device.answer(Request("GET", path, parameters))


def told(device, group="ptzf"):
    reply = get(device, "/command/inquiry.cgi", inq=group)
    assert reply.status == 200
    return dict(pair.split("=") for pair in reply.body.decode().split("&"))


def done(device, clock, **parameters):
    reply = get(device, "/command/ptzf.cgi", **parameters)
    clock.advance(1)
    return reply.status


class TestSRG:
    def test_the_known_exchange(self, srg, clock):
        assert done(srg, clock, absolutepantilt="15400,fd578,24", absolutezoom="0000") == 204
        text = get(srg, "/command/inquiry.cgi", inq="ptzf").body.decode()
        focus = text.split("&")[0].split(",")[3]
        assert text.startswith(SRG_PTZF.replace("FOCUS", focus))
        pose = srg.camera.reading()
        assert degrees(pose.pan) == pytest.approx(-170)  # raw pan grows to the right,
        assert degrees(pose.tilt) == pytest.approx(10888 / 512)  # raw tilt upward

    def test_identity(self, srg):
        system = told(srg, "system")
        assert (system["ModelName"], system["ModelForm"]) == ("SRG-X400", "box")

    def test_its_flag_moves_with_the_head(self, srg, clock):
        get(srg, "/command/ptzf.cgi", absolutepantilt="0000,0000,1")
        clock.advance(1)
        get(srg, "/command/ptzf.cgi", absolutepantilt="15400,0000,1")
        assert told(srg)["PtzfStatus"].startswith("moving")
        clock.advance(1)
        assert told(srg)["PtzfStatus"] == "idle,idle,idle,idle"

    @pytest.mark.parametrize(
        ("fault", "word"), [("stuck_moving", "moving"), ("always_idle", "idle")]
    )
    def test_its_flag_may_lie(self, srg, fault, word):
        srg.camera.set_faults(**{fault: True})
        get(srg, "/command/ptzf.cgi", absolutepantilt="15400,0000,1")
        assert told(srg)["PtzfStatus"] == f"{word},{word},{word},idle"

    def test_its_flag_shows_one_autofocus(self, srg, clock):
        assert done(srg, clock, focusmode="manual") == 204
        get(srg, "/command/ptzf.cgi", move="onepushaf,8")
        assert told(srg)["PtzfStatus"] == "idle,idle,idle,moving"
        clock.advance(1)
        assert told(srg)["PtzfStatus"] == "idle,idle,idle,idle"


class TestSixteenBits:
    @pytest.mark.parametrize(
        ("raw", "text"), [(-1000, "fc18"), (-1, "ffff"), (0, "0000"), (0x3FF, "03ff")]
    )
    def test_negative_numbers(self, rx, clock, raw, text):
        assert done(rx, clock, absolutepantilt=f"{text},{text},24") == 204
        assert told(rx)["AbsolutePTZF"].startswith(f"{text},{text},")
        assert degrees(rx.camera.reading().pan) == pytest.approx(-0.022 * raw)

    def test_short_numbers_are_taken_too(self, rx, clock):
        assert done(rx, clock, absolutepantilt="9ff,4f,24") == 204
        assert told(rx)["AbsolutePTZF"].startswith("09ff,004f,0000,")

    def test_all_in_one(self, rx, clock):
        rx.camera.focus.auto = False
        assert done(rx, clock, absoluteptzf="fc18,0010,2000,1770") == 204
        assert told(rx)["AbsolutePTZF"] == "fc18,0010,2000,1770"

    def test_ranges_are_those_of_the_head(self, rx):
        assert told(rx)["PanMovementRange"] == "e1d1,1e2f"
        assert told(rx)["TiltMovementRange"] == "f005,0470"
        assert "PtzfStatus" not in told(rx)

    def test_another_models_units(self, rx, clock):
        coarse = SonyNamed(rx.camera, units_per_deg=10)
        done(coarse, clock, absolutepantilt="0064,0000,24")
        assert rx.camera.reading().pan == pytest.approx(-radians(10), abs=radians(0.022))

    @pytest.mark.parametrize(
        "parameters",
        [
            {},
            {"nonsense": "1"},
            {"absolutepantilt": "1,2"},
            {"absolutepantilt": "1,2,25"},
            {"absolutepantilt": "15400,0,24"},
            {"absolutepantilt": "-1,0,24"},
            {"absolutezoom": "12345"},
            {"absoluteptzf": "1,2,3"},
            {"focusmode": "perhaps"},
            {"move": "sideways,1"},
        ],
    )
    def test_nonsense_is_refused(self, rx, parameters):
        assert get(rx, "/command/ptzf.cgi", **parameters).status == 400
        assert not rx.camera.moving()

    def test_unknown_paths_and_groups(self, rx):
        assert get(rx, "/command/visca-inquiry.cgi", visca="81090612ff").status == 404
        assert get(rx, "/command/inquiry.cgi", inq="secrets").status == 400


class TestSwitches:
    def test_focus(self, rx, clock):
        rx.camera.focus.position = 5000
        assert done(rx, clock, focusmode="manual") == 204
        assert told(rx)["FocusMode"] == "manual"
        assert done(rx, clock, move="onepushaf,8") == 204
        assert rx.camera.focus.position == 1000

    @pytest.mark.parametrize(
        ("group", "key"), [("superimpose", "SiEnableImage1"), ("imaging", "Stabilizer")]
    )
    def test_overlay_and_stabiliser(self, rx, group, key):
        for word in ("off", "on"):
            assert get(rx, f"/command/{group}.cgi", **{key.lower(): word}).status == 204
            assert told(rx, group)[key] == word
        assert get(rx, f"/command/{group}.cgi", **{key.lower(): "?"}).status == 400

    def test_stops(self, rx, clock):
        get(rx, "/command/ptzf.cgi", absolutepantilt="1e2f,0000,1", absolutezoom="4000")
        clock.advance(0.001)
        assert done(rx, clock, move="stop,motor,image1") == 204
        assert abs(rx.camera.reading().pan) < radians(100)
        assert rx.camera.reading().zoom_units == 0x4000


class TestFaults:
    def test_no_position(self, srg):
        srg.camera.set_faults(no_position=True)
        assert "AbsolutePTZF" not in told(srg)
        assert told(srg)["PanMovementRange"] == "eac00,15400"

    def test_a_move_without_zoom_zooms_out(self, rx, clock):
        done(rx, clock, absolutezoom="2000")
        rx.camera.set_faults(zoom_reset_by_pan_tilt=True)
        done(rx, clock, absolutepantilt="0000,0010,24", absolutezoom="2000")
        assert rx.camera.reading().zoom_units == 0x2000
        done(rx, clock, absolutepantilt="0000,0000,24")
        assert rx.camera.reading().zoom_units == 0
