from math import radians

import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchptz.simulation.dialects.visca import Visca, ViscaError, from_nibbles, to_nibbles


@pytest.fixture
def visca(make_camera):
    return Visca(make_camera(head={"speed_up": 1000}))


def done(visca, clock, *messages):
    for message in messages:
        visca.command(message.lower())
        clock.advance(1)


class TestNibbles:
    @given(st.integers(-0x8000, 0x7FFF))
    def test_round_trip(self, value):
        assert from_nibbles(to_nibbles(value)) == value

    @pytest.mark.parametrize(
        ("value", "text"), [(-1296, "0f0a0f00"), (-123, "0f0f0805"), (972, "00030c0c")]
    )
    def test_written_examples(self, value, text):
        assert to_nibbles(value) == text

    @pytest.mark.parametrize("text", ["1f0a0f00", "0f0a0f", "0f0a0f0x"])
    def test_refused(self, text):
        with pytest.raises(ValueError, match=r"nibbles|base 16"):
            from_nibbles(text)


class TestDirections:
    def test_positive_raw_pan_turns_right(self, visca, clock):
        done(visca, clock, "8101060218140001020000000000ff")  # pan raw 0x0120 = 288 = 20 degrees
        assert visca.camera.head.reading().pan == pytest.approx(-radians(20))

    @pytest.mark.parametrize(("raw", "down_deg"), [(-828, -25), (0, 27.9), (972, 90)])
    def test_raw_tilt_grows_downward(self, visca, clock, raw, down_deg):
        done(visca, clock, f"81010602181400000000{to_nibbles(raw)}ff")
        assert visca.camera.head.reading().tilt == pytest.approx(radians(down_deg))
        assert visca.inquire("81090612ff") == f"905000000000{to_nibbles(raw)}ff"

    @pytest.mark.parametrize(
        ("way", "limit"),
        [("0203", (-2448, 0)), ("0103", (2448, 0)), ("0301", (0, 972)), ("0302", (0, -828))],
    )
    def test_drive_runs_to_the_limit(self, visca, clock, way, limit):
        done(visca, clock, f"810106011814{way}ff")
        assert visca.raw_position() == limit


class TestPanTilt:
    def test_every_reachable_step_reads_back(self, visca, clock):
        for pan, tilt in ((-2448, -828), (2448, 972), (-1, 1), (1, -1), (777, -333)):
            done(visca, clock, f"810106021814{to_nibbles(pan)}{to_nibbles(tilt)}ff")
            assert visca.raw_position() == (pan, tilt)

    def test_relative_home_and_reset(self, visca, clock):
        done(visca, clock, f"810106021814{to_nibbles(100)}{to_nibbles(-50)}ff")
        done(visca, clock, f"810106031814{to_nibbles(-30)}{to_nibbles(20)}ff")
        assert visca.raw_position() == (70, -30)
        done(visca, clock, "81010604ff")
        assert visca.raw_position() == (0, 0)

    def test_stop_on_the_way(self, make_camera, clock):
        visca = Visca(make_camera())
        visca.command("810106010a0a0103ff")  # 14 degrees a second to the right
        clock.advance(2)
        visca.command("810106010a0a0303ff")
        clock.advance(2)
        pan, tilt = visca.raw_position()
        assert 14.4 * 26 < pan < 14.4 * 29
        assert tilt == 0

    def test_speed_code_decides_the_time(self, make_camera, clock):
        visca = Visca(make_camera(head={"acceleration_deg": 1e6, "ring_deg": 0}))
        visca.command("8101060208140005 0a00 00000000ff".replace(" ", ""))  # 100 degrees at 9.1/s
        clock.advance(100 / 9.1 - 0.01)
        assert visca.camera.head.moving()
        clock.advance(0.02)
        assert not visca.camera.head.moving()

    def test_stuck_head_accepts_and_stays(self, visca, clock):
        visca.camera.set_faults(head_stuck=True)
        done(visca, clock, "810106021814 0001020000000000ff".replace(" ", ""))
        assert visca.raw_position() == (0, 0)


class TestLens:
    def test_zoom_and_its_digital_range(self, visca, clock):
        done(visca, clock, "8101040602ff", "8101044707000a0bff")
        assert visca.inquire("81090447ff") == "905007000a0bff"
        assert visca.inquire("81090446ff") == "9050" + to_nibbles((0x70AB - 0x4000) // 64) + "ff"
        assert visca.inquire("81090406ff") == "905002ff"
        done(visca, clock, "8101040603ff")
        assert visca.inquire("81090447ff") == "905004000000ff"
        assert visca.inquire("81090406ff") == "905003ff"
        done(visca, clock, "8101044707000a0bff")
        assert visca.inquire("81090447ff") == "905004000000ff"

    def test_digital_position_1x_returns_to_the_optical_end(self, visca, clock):
        done(visca, clock, "8101040602ff", "8101044707000000ff", "8101044600000000ff")
        assert visca.raw_zoom() == 0x4000
        done(visca, clock, "8101044701080000ff", "8101044600000000ff")
        assert visca.raw_zoom() == 0x1800

    def test_zoom_drive(self, visca, clock):
        done(visca, clock, "8101040603ff", "8101040727ff")
        assert visca.raw_zoom() == 0x4000
        done(visca, clock, "8101040730ff", "8101040700ff")
        assert visca.raw_zoom() == 0

    def test_focus(self, visca, clock):
        assert visca.inquire("81090438ff") == "905002ff"
        with pytest.raises(ViscaError, match="906141ff"):
            visca.command("8101044802000000ff")
        done(visca, clock, "8101041801ff", "8101043803ff", "8101044802000000ff")
        assert visca.inquire("81090438ff") == "905003ff"
        assert visca.inquire("81090448ff") == "905002000000ff"
        done(visca, clock, "8101043802ff")
        assert visca.inquire("81090438ff") == "905002ff"

    def test_stabiliser(self, visca, clock):
        assert visca.inquire("81090434ff") == "905002ff"
        done(visca, clock, "8101043403ff")
        assert visca.inquire("81090434ff") == "905003ff"
        assert visca.camera.stabiliser is False

    def test_no_position(self, visca):
        visca.camera.set_faults(no_position=True)
        for inquiry in ("81090612ff", "81090447ff"):
            with pytest.raises(ViscaError, match="906141ff"):
                visca.inquire(inquiry)


@pytest.mark.parametrize(
    "message",
    [
        "81010602ff",  # nothing in it
        "81010602191400000000" + "00000000ff",  # pan speed 19
        "81010602181500000000" + "00000000ff",  # tilt speed 15
        "81010602181410000000" + "00000000ff",  # a high nibble
        "810104990000ff",
        "8101090612ff",
        "8201060400ff",
        "810106040000",
    ],
)
def test_nonsense_is_a_syntax_error(visca, message):
    with pytest.raises(ViscaError, match="906002ff"):
        visca.command(message)
    assert visca.raw_position() == (0, 0)
