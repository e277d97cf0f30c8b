import pytest

from torchptz.cameras import DIALECTS, open_camera
from torchptz.cameras.driver import Driver


class TestOpenCamera:
    @pytest.mark.parametrize("dialect", sorted(DIALECTS))
    def test_every_dialect_opens_without_traffic(self, dialect, device, http_reply):
        fake = device(lambda _: http_reply())
        camera = open_camera(dialect, "gate", fake.address, None)
        assert isinstance(camera, Driver)
        assert camera.name == "gate"
        assert fake.requests == []

    def test_options_reach_the_driver(self):
        camera = open_camera("sony_rz30", "gate", "host", None, tilt_sign=-1)
        low, high = camera.capabilities.tilt_limits
        assert low < -1.5
        assert high < 0.5

    def test_unknown_dialect_lists_the_known(self):
        with pytest.raises(ValueError, match=r"camera gate: unknown dialect 'sony'.*sony_rz30"):
            open_camera("sony", "gate", "host", None)

    def test_unknown_option_lists_the_known(self):
        with pytest.raises(ValueError, match=r"camera gate: .*'pan_sing'.*pan_sign, tilt_sign"):
            open_camera("sony_rz30", "gate", "host", None, pan_sing=-1)

    def test_malformed_address(self):
        with pytest.raises(ValueError, match="camera gate: the address 'http://host'"):
            open_camera("sony_rz30", "gate", "http://host", None)

    def test_drives_a_camera(self, rz30):
        camera = open_camera("sony_rz30", "gate", rz30.device.address, rz30.credentials)
        assert camera.snapshot().shape == (48, 64, 3)
