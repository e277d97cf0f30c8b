"""Reading the answers of VAPIX."""

import numpy as np
import pytest

from torchptz.cameras.axis import parameters as vapix


class TestStep:
    @pytest.mark.parametrize(
        ("readings", "step"),
        [
            (["51.2891", "46.1914", "0.0000"], 1 / 256),  # of a real unit
            (["51,2891"], 1 / 256),
            (["0.0000"], 1 / 256),  # tells nothing
            (["0.0", "12.0", "-3.5"], 0.1),
            (["51.29", "46.19", "3.07"], 0.01),
            (["51.2700", "46.1900", "3.0700"], 0.01),
            (["51.2700"], 1e-4),
            (["51.2891", "46.1914", "0.0017"], 1e-4),
        ],
    )
    def test_from_printed_numbers(self, readings, step):
        assert vapix.step_of(readings) == pytest.approx(step)

    def test_chance_does_not_make_sixteenths_of_sixteenths(self):
        printed = [f"{angle:.4f}" for angle in np.random.default_rng(0).uniform(-170, 170, 8)]
        assert vapix.step_of(printed) == pytest.approx(1e-4)


class TestAnswers:
    def test_values_by_key_whatever_parts_them(self):
        body = b"pan=51.2891\r\ntilt=46.1914 zoom=1\n\nPreset Positions"
        assert vapix.values(body) == {"pan": "51.2891", "tilt": "46.1914", "zoom": "1"}

    def test_parameters_keep_their_spaces_and_lose_their_root(self):
        body = b"root.Brand.ProdFullName=AXIS V5915 PTZ\r\n# Error: no=thing\nBrand.WebURL=a=b\n"
        assert vapix.parameters(body) == {
            "Brand.ProdFullName": "AXIS V5915 PTZ",
            "Brand.WebURL": "a=b",
        }

    @pytest.mark.parametrize(
        ("body", "words"),
        [
            (b"Error:\r\nquery: unknown value: foo", "Error: query: unknown value: foo"),
            (b"# Error: Error setting 'root.A' to '1'!", "# Error: Error setting 'root.A' to '1'!"),
            (b"<html><h1>400 Bad Request</h1>\x1b</html>", "400 Bad Request"),
            (b"<" + b"x" * 500, "<" + "x" * 79),
            (b"<p></p>", "an empty page"),
            (b"OK", None),
            (b"", None),
            (b"speed=100\nErrors=0", None),
        ],
    )
    def test_trouble_inside_a_good_reply(self, body, words):
        assert vapix.trouble_in(body) == words

    @pytest.mark.parametrize(
        ("limits", "told"),
        [
            ({"MaxFieldAngle": "623", "MinFieldAngle": "22"}, True),
            ({"MaxFieldAngle": "100", "MinFieldAngle": "1"}, False),  # of a digital head
            ({"MaxFieldAngle": "22", "MinFieldAngle": "623"}, False),
            ({"MaxFieldAngle": "623", "MinFieldAngle": "?"}, False),
            ({"MaxFieldAngle": "623"}, False),
        ],
    )
    def test_field_angles_of_a_lens_only(self, limits, told):
        assert (vapix.field_angles(limits) is not None) == told

    def test_sizes(self):
        listed = vapix.sizes("640x480, 1920x1080,4CIF,1080x1920,320x")
        assert listed == ["640x480", "1920x1080", "1080x1920"]
        assert vapix.largest(listed) == "1920x1080"
        assert vapix.largest([]) is None

    @pytest.mark.parametrize("text", ["", "nan", "1,2,3", "inf", "on"])
    def test_number(self, text):
        with pytest.raises(ValueError, match=r"\S"):
            vapix.number(text)
