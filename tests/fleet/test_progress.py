"""Progress as lines of text."""

import re

from torchptz.fleet.progress import Stages


def test_a_line_for_everything_new_of_every_camera():
    lines = []
    stages = Stages(lines.append)
    for done in range(3):
        stages("north", "zoom 1/2", done, 3)
        stages("east", "connecting", done, 3)
    stages("north", "zoom 2/2", 0, 3)
    assert [re.sub(r"^ *\d+\.\d s  ", "", line) for line in lines] == [
        "north: zoom 1/2",
        "east: connecting",
        "north: zoom 2/2",
    ]
    assert all(re.match(r" *\d+\.\d s  \w", line) for line in lines)
