"""Files: whole or absent, JSON without NaN, arrays without pickles."""

import json
import math

import numpy as np
import pytest

from torchptz.files import read_arrays, whole_file, without_nan, write_whole


class TestWholeFile:
    def test_text_and_bytes(self, tmp_path):
        write_whole(tmp_path / "new" / "text", "Höhe\n")
        write_whole(tmp_path / "new" / "bytes", b"\x00\xff")
        assert (tmp_path / "new" / "text").read_bytes() == "Höhe\n".encode()
        assert (tmp_path / "new" / "bytes").read_bytes() == b"\x00\xff"

    def test_it_has_its_name_only_when_it_is_complete(self, tmp_path):
        path = tmp_path / "file"
        path.write_text("old")
        with whole_file(path) as file:
            file.write(b"new")
            file.flush()
            assert path.read_text() == "old"
        assert path.read_text() == "new"

    @pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
    def test_a_failed_write_leaves_the_old_file_and_nothing_else(self, tmp_path, error):
        path = tmp_path / "file"
        path.write_text("old")

        def write():
            with whole_file(path) as file:
                file.write(b"half")
                raise error

        with pytest.raises(error):
            write()
        assert path.read_text() == "old"
        assert list(tmp_path.iterdir()) == [path]

    def test_text_that_cannot_be_encoded(self, tmp_path):
        write_whole(tmp_path / "file", "old")
        with pytest.raises(UnicodeEncodeError):
            write_whole(tmp_path / "file", "new \ud800")
        assert (tmp_path / "file").read_text() == "old"


def test_without_nan_is_what_json_can_hold():
    value = {"a": (1, math.nan), "b": [{"c": -math.inf}, np.float64("nan")], "d": "nan", "e": True}
    plain = without_nan(value)
    assert plain == {"a": [1, None], "b": [{"c": None}, None], "d": "nan", "e": True}
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain


class TestReadArrays:
    def test_what_was_saved(self, tmp_path):
        np.savez(tmp_path / "a.npz", x=np.arange(3), y=np.eye(2))
        arrays = read_arrays(tmp_path / "a.npz", "a harp")
        assert arrays["x"].tolist() == [0, 1, 2]
        assert arrays["y"].tolist() == np.eye(2).tolist()

    def test_a_missing_file_is_missing(self, tmp_path):
        with pytest.raises(FileNotFoundError):
            read_arrays(tmp_path / "a.npz", "a harp")

    def test_any_damage_is_named(self, tmp_path):
        path = tmp_path / "a.npz"
        np.savez_compressed(path, x=np.random.default_rng(0).normal(size=40), y=np.arange(9))
        whole = path.read_bytes()
        refused = 0
        for start in range(0, len(whole) - 4, 3):
            path.write_bytes(whole[:start] + b"\xff\x7f\xff\x7f" + whole[start + 4 :])
            try:
                read_arrays(path, "a harp")  # not every byte matters
            except ValueError as error:
                assert str(error).startswith(f"{path}: not a harp (")  # noqa: PT017
                refused += 1
        assert refused > 50

    def test_a_lone_array_and_pickles(self, tmp_path):
        np.save(tmp_path / "a.npy", np.zeros(3))
        np.savez(tmp_path / "b.npz", x=np.array([{}], dtype=object))
        for name in ("a.npy", "b.npz"):
            with pytest.raises(ValueError, match=rf"{name}: not a harp"):
                read_arrays(tmp_path / name, "a harp")
