import pytest

from torchptz.cameras import AuthenticationError, ConnectionFailed, ProtocolError
from torchptz.cameras.sony.rz30 import SonyRZ30Camera
from torchptz.cameras.switches import switch


class Setting:
    """What a device has of it: a value, and an error that its next change ends with."""

    def __init__(self):
        self.value, self.error, self.arrives = "on", None, True

    def change_to(self, value):
        error, self.error = self.error, None
        if error is None or self.arrives:
            self.value = value
        if error is not None:
            raise error


@pytest.fixture
def setting():
    return Setting()


@pytest.fixture
def driver():
    return SonyRZ30Camera("gate", "host")


def off(driver, setting):
    return switch(
        driver,
        "light",
        lambda: setting.change_to("off"),
        lambda: setting.change_to("on"),
        "use the wall",
    )


def test_a_change_is_undone(driver, setting):
    assert off(driver, setting) is True
    assert setting.value == "off"
    driver.restore()
    assert (setting.value, driver.notes) == ("on", [])


def test_a_refusal_is_noted_once_and_leaves_nothing_to_undo(driver, setting):
    for _ in range(2):
        setting.error, setting.arrives = ProtocolError("404"), False
        assert off(driver, setting) is False
    assert driver.notes == ["its light cannot be switched from here: use the wall"]
    setting.value = "set by somebody"
    driver.restore()
    assert setting.value == "set by somebody"


def test_a_change_of_which_nobody_knows_is_undone(driver, setting):
    setting.error = ConnectionFailed("silent")
    with pytest.raises(ConnectionFailed):
        off(driver, setting)
    driver.restore()
    assert setting.value == "on"


def test_a_refused_login_changed_nothing(driver, setting):
    setting.error, setting.arrives = AuthenticationError("401"), False
    with pytest.raises(AuthenticationError):
        off(driver, setting)
    setting.value = "set by somebody"
    driver.restore()
    assert setting.value == "set by somebody"
