"""One autofocus for each zoom, and the same focus at every return."""

from tests.fake_camera import FakeCamera, capabilities
from torchptz.scanning.focus import FocusPerZoom


class Lens(FakeCamera):
    def __init__(self, tells=True):
        super().__init__(None, None, None, 700.0, capabilities(zoom_limits=(0.0, 1000.0)))
        self.calls, self.tells = [], tells

    def focus_once(self):
        self.calls.append("once")
        return 100.0 + len(self.calls) if self.tells else None

    def set_focus(self, focus):
        self.calls.append(focus)


def test_each_zoom_is_focused_once_and_found_again():
    lens = Lens()
    focus = FocusPerZoom(lens)
    for zoom in (10, 10, 500, 500.2, 10, 500):
        focus.at(zoom)
    assert lens.calls == ["once", "once", 101.0, 102.0]


def test_a_lens_that_cannot_be_sent_to_a_focus_is_left_alone():
    lens = Lens(tells=False)
    focus = FocusPerZoom(lens)
    for zoom in (10, 500, 10, 10):
        focus.at(zoom)
    assert lens.calls == ["once", "once"]
