import threading
import time

import cv2
import numpy as np
import pytest

from torchptz.cameras.http.picture import DamagedPicture, decode_jpeg

END = b"\xff\xd9"
PLAIN = ()
RESTARTS = (cv2.IMWRITE_JPEG_RST_INTERVAL, 5)
PROGRESSIVE = (cv2.IMWRITE_JPEG_PROGRESSIVE, 1)


def with_segment(data: bytes, marker: int, body: bytes) -> bytes:
    """The picture with an APPn segment after its first marker."""
    return data[:2] + bytes([0xFF, marker]) + (len(body) + 2).to_bytes(2, "big") + body + data[2:]


@pytest.fixture(params=[PLAIN, RESTARTS, PROGRESSIVE], ids=["plain", "restarts", "progressive"])
def picture(request, jpeg) -> bytes:
    return jpeg.encode(jpeg.texture(96, 120), *request.param)


class TestComplete:
    def test_decodes_as_opencv_does(self, picture):
        expected = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
        image = decode_jpeg(picture)
        assert image.dtype == np.uint8
        np.testing.assert_array_equal(image, expected)

    @pytest.mark.parametrize("padding", [b"\0", b"\0" * 500, b"\r\n", b"\xff\xff\0"])
    def test_padding_at_the_end_is_no_damage(self, picture, padding):
        np.testing.assert_array_equal(decode_jpeg(picture + padding), decode_jpeg(picture))

    @pytest.mark.parametrize("level", [0, 127, 128, 129, 255])
    def test_a_flat_picture_is_no_damage(self, jpeg, level):
        image = decode_jpeg(jpeg.encode(np.full((40, 50, 3), level, np.uint8)))
        assert image.shape == (40, 50, 3)
        assert np.abs(image.astype(int) - level).max() <= 1

    @pytest.mark.parametrize("size", [(1, 1), (8, 9), (17, 31), (96, 100), (545, 737)])
    @pytest.mark.parametrize("options", [PLAIN, RESTARTS], ids=["plain", "restarts"])
    def test_any_size(self, jpeg, size, options):
        assert decode_jpeg(jpeg.encode(jpeg.texture(*size), *options)).shape == (*size, 3)

    def test_grey_picture_comes_as_colour(self, jpeg):
        data = jpeg.encode(jpeg.texture(32, 40)[..., 0], *RESTARTS)
        assert decode_jpeg(data).shape == (32, 40, 3)

    def test_embedded_rotation_is_not_applied(self, jpeg):
        # An EXIF block that says: turn by 90 degrees (orientation 6).
        tiff = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
        data = with_segment(jpeg.encode(jpeg.texture(32, 48)), 0xE1, b"Exif\0\0" + tiff)
        turned = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert turned.shape == (48, 32, 3), "the rotation must be readable for this to prove much"
        assert decode_jpeg(data).shape == (32, 48, 3)


class TestCut:
    def test_at_any_place(self, picture):
        for end in range(0, len(picture) - 1, 7):
            with pytest.raises(DamagedPicture):
                decode_jpeg(picture[:end])

    def test_the_message_counts_the_bytes(self, picture):
        with pytest.raises(DamagedPicture, match=f"cut off after {len(picture) // 2} bytes"):
            decode_jpeg(picture[: len(picture) // 2])

    def test_half_an_end_marker(self, picture):
        with pytest.raises(DamagedPicture, match="cut off"):
            decode_jpeg(picture[:-1])

    def test_an_end_marker_inside_a_thumbnail_is_not_the_end(self, jpeg):
        thumbnail = jpeg.encode(jpeg.texture(16, 16))
        data = with_segment(jpeg.encode(jpeg.texture(96, 120)), 0xE1, thumbnail)
        assert decode_jpeg(data).shape == (96, 120, 3)
        with pytest.raises(DamagedPicture):
            decode_jpeg(data[: 6 + len(thumbnail)])

    @pytest.mark.parametrize("options", [PLAIN, RESTARTS], ids=["plain", "restarts"])
    @pytest.mark.parametrize("part", [0.4, 0.7, 0.9, 0.97])
    def test_an_end_marker_after_the_cut_does_not_hide_it(self, jpeg, options, part):
        data = jpeg.encode(jpeg.texture(96, 120), *options)
        cut = data[: int(len(data) * part)].rstrip(b"\xff")
        with pytest.raises(DamagedPicture):
            decode_jpeg(cut + END)

    @pytest.mark.parametrize("options", [PLAIN, RESTARTS], ids=["plain", "restarts"])
    def test_a_stretch_missing_in_the_middle(self, jpeg, options):
        data = jpeg.encode(jpeg.texture(96, 120), *options)
        with pytest.raises(DamagedPicture):
            decode_jpeg(data[: len(data) // 2] + data[len(data) * 3 // 4 :])


class TestOtherDamage:
    @pytest.mark.parametrize("data", [b"<html>no</html>", b"\x89PNG\r\n", b"\0" * 100])
    def test_no_jpeg(self, data):
        with pytest.raises(DamagedPicture, match="no JPEG"):
            decode_jpeg(data)

    def test_empty(self):
        with pytest.raises(DamagedPicture, match="empty"):
            decode_jpeg(b"")

    def test_more_than_padding_at_the_end(self, picture):
        with pytest.raises(DamagedPicture, match="follow the end"):
            decode_jpeg(picture + b"--myboundary")

    def test_headers_without_a_frame(self):
        with pytest.raises(DamagedPicture, match="no frame header"):
            decode_jpeg(b"\xff\xd8" + END)

    def test_random_changes_raise_nothing_else(self, picture):
        random = np.random.default_rng(5)
        outcomes = set()
        for _ in range(300):
            data = bytearray(picture)
            for at in random.integers(0, 700, 3):
                data[at] = random.integers(256)
            try:
                decode_jpeg(bytes(data))
                outcomes.add("decoded")
            except DamagedPicture:
                outcomes.add("refused")
        assert outcomes == {"decoded", "refused"}


class TestLimits:
    def test_bytes(self, picture):
        with pytest.raises(DamagedPicture, match="limit of 100"):
            decode_jpeg(picture, max_bytes=100)

    def test_pixels_are_judged_before_decoding(self, picture, monkeypatch):
        monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("was decoded"))
        at = picture.index(b"\xff\xc2" if b"\xff\xc2" in picture else b"\xff\xc0")
        huge = picture[: at + 5] + b"\xff\xff\xff\xff" + picture[at + 9 :]
        with pytest.raises(DamagedPicture, match="65535 x 65535"):
            decode_jpeg(huge)

    def test_too_few_bytes_for_so_many_pixels(self, jpeg, monkeypatch):
        small = jpeg.encode(np.zeros((16, 16, 3), np.uint8))
        assert decode_jpeg(small).shape == (16, 16, 3)
        monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("was decoded"))
        at, side = small.index(b"\xff\xc0") + 5, (4800).to_bytes(2, "big")
        with pytest.raises(DamagedPicture, match="cannot be a picture of 4800 x 4800 pixels"):
            decode_jpeg(small[:at] + side + side + small[at + 4 :])

    def test_no_more_than_two_pictures_are_decoded_at_once(self, picture, monkeypatch):
        now, most, real = [], [0], cv2.imdecode

        def counted(*args):
            now.append(1)
            most[0] = max(most[0], len(now))
            time.sleep(0.02)
            now.pop()
            return real(*args)

        monkeypatch.setattr(cv2, "imdecode", counted)
        threads = [threading.Thread(target=decode_jpeg, args=(picture,)) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert most == [2]

    def test_a_picture_is_decoded_once_where_its_corner_is_not_grey(self, jpeg, monkeypatch):
        calls, real = [], cv2.imdecode
        monkeypatch.setattr(cv2, "imdecode", lambda *args: calls.append(1) or real(*args))
        decode_jpeg(jpeg.encode(jpeg.texture(48, 64)))
        assert len(calls) == 1
