"""The journal: what is written can be read, also after a crash, and nothing is overwritten."""

import json
from dataclasses import replace

import numpy as np
import pytest

from torchptz.cameras import Pose
from torchptz.fleet.journal import JOURNAL_NAME, Journal, read_journal
from torchptz.scanning.observation import Observation

FOUND = Observation(
    purpose="line",
    zoom_index=1,
    group=7,
    commanded=Pose(0.1, -0.2, 5638.0),
    read_before=Pose(0.1 + 1e-16, -0.2, 5638.0),
    read_after=Pose(1 / 3, -0.2, 5638.0),
    pixel=(211.123456789012345, 0.1),
    sigma=0.03,
    radius=4.5,
    quality=0.9,
    reason=None,
    rest_rule="readings agree",
    taken_at=1.7e9 + 0.123456,
)
MISSED = replace(
    FOUND, pixel=None, sigma=None, radius=None, quality=None, reason='nothing — "bright"\nthere'
)


@pytest.fixture
def stored(tmp_path):
    """A journal of three observations, closed."""
    journal = Journal(tmp_path)
    for one in (FOUND, MISSED, FOUND):
        journal.write(one)
    journal.close()
    return tmp_path / JOURNAL_NAME


class TestRoundTrip:
    def test_every_field_to_the_last_digit(self, stored):
        assert list(read_journal(stored)) == [FOUND, MISSED, FOUND]

    def test_one_json_object_a_line(self, stored):
        lines = stored.read_text().split("\n")
        assert lines.pop() == ""
        assert [json.loads(line)["purpose"] for line in lines] == ["line"] * 3

    def test_numbers_of_numpy(self, tmp_path):
        journal = Journal(tmp_path)
        journal.write(replace(FOUND, sigma=np.float64(0.03)))
        journal.close()
        assert list(read_journal(tmp_path / JOURNAL_NAME)) == [FOUND]

    def test_what_is_not_finite_is_null_and_valid_json(self, tmp_path):
        journal = Journal(tmp_path)
        journal.write(replace(FOUND, sigma=float("nan"), radius=float("inf")))
        journal.close()
        text = (tmp_path / JOURNAL_NAME).read_text()
        assert "NaN" not in text
        assert "Infinity" not in text
        (seen,) = read_journal(tmp_path / JOURNAL_NAME)
        assert seen == replace(FOUND, sigma=None, radius=None)

    def test_an_empty_one(self, tmp_path):
        Journal(tmp_path).close()
        assert list(read_journal(tmp_path / JOURNAL_NAME)) == []


class TestCrash:
    def test_on_disk_before_it_is_closed(self, tmp_path):
        journal = Journal(tmp_path / "new" / "folder")
        journal.write(FOUND)
        assert list(read_journal(tmp_path / "new" / "folder" / JOURNAL_NAME)) == [FOUND]
        journal.close()

    def test_a_last_line_cut_anywhere_is_left_out(self, stored):
        whole = stored.read_bytes()
        length = len(whole.split(b"\n")[2])
        for cut in (2, 3, length // 2, length - 1, length):
            stored.write_bytes(whole[:-cut])
            assert list(read_journal(stored)) == [FOUND, MISSED]

    def test_a_last_line_that_lacks_only_its_end_is_kept(self, stored):
        stored.write_bytes(stored.read_bytes()[:-1])
        assert len(list(read_journal(stored))) == 3

    @pytest.mark.parametrize(
        "bad", ['{"purpose": "li', "{}", "[1, 2]", "null", '{"commanded": {"pan": 1}}']
    )
    @pytest.mark.parametrize("number", [2, 3])
    def test_a_whole_line_that_is_no_observation_is_named(self, stored, bad, number):
        """Also the last one: a crash cuts lines, it does not end them."""
        lines = stored.read_text().splitlines()
        lines[number - 1] = bad
        stored.write_text("\n".join(lines) + "\n")
        with pytest.raises(ValueError, match=rf"{JOURNAL_NAME}, line {number}: not an observation"):
            list(read_journal(stored))

    def test_observations_before_a_bad_line_are_read(self, stored):
        lines = stored.read_text().splitlines()
        stored.write_text("\n".join([lines[0], "?", lines[2]]) + "\n")
        reading = read_journal(stored)
        assert next(reading) == FOUND
        with pytest.raises(ValueError, match="line 2"):
            next(reading)


class TestEarlierJournals:
    def test_are_kept_under_numbered_names(self, stored):
        folder = stored.parent
        for sigma in (0.1, 0.2):
            journal = Journal(folder)
            journal.write(replace(FOUND, sigma=sigma))
            journal.close()
        assert list(read_journal(folder / "observations.1.jsonl")) == [FOUND, MISSED, FOUND]
        assert [one.sigma for one in read_journal(folder / "observations.2.jsonl")] == [0.1]
        assert [one.sigma for one in read_journal(stored)] == [0.2]
        assert len(list(folder.iterdir())) == 3

    def test_closing_twice_is_allowed(self, tmp_path):
        journal = Journal(tmp_path)
        journal.close()
        journal.close()
