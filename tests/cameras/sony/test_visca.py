import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchptz.cameras.sony import visca


class TestNumbers:
    @pytest.mark.parametrize(
        ("value", "text"),
        [
            (-1296, "0F0A0F00"),
            (-123, "0F0F0805"),
            (-2448, "0F060700"),
            (2448, "00090900"),
            (-828, "0F0C0C04"),
            (972, "00030C0C"),
            (0, "00000000"),
        ],
    )
    def test_published_values(self, value, text):
        assert visca.encode_signed(value) == text
        assert visca.decode_signed(bytes.fromhex(text)) == value

    def test_round_trip_of_every_signed_value(self):
        for value in range(-0x8000, 0x8000):
            assert visca.decode_signed(bytes.fromhex(visca.encode_signed(value))) == value

    @given(st.integers(0, 0xFFFF))
    def test_round_trip_unsigned(self, value):
        text = visca.encode_unsigned(value)
        assert text[::2] == "0000"
        assert visca.decode_unsigned(bytes.fromhex(text)) == value

    @pytest.mark.parametrize("value", [-0x8001, 0x8000])
    def test_refuses_signed_overflow(self, value):
        with pytest.raises(ValueError, match="16 bits"):
            visca.encode_signed(value)

    @pytest.mark.parametrize("value", [-1, 0x10000])
    def test_refuses_unsigned_overflow(self, value):
        with pytest.raises(ValueError, match="16 bits"):
            visca.encode_unsigned(value)


class TestReplies:
    @pytest.mark.parametrize(
        "body",
        [
            b"9050000000000f0c0c04ff",
            b"9050000000000F0C0C04FF",
            b" 9050000000000F0c0C04fF\r\n",
            b"9041ff9050000000000f0c0c04ff",
        ],
    )
    def test_pan_tilt_answer_of_any_case(self, body):
        data = visca.answer(body, 8)
        assert visca.decode_signed(data[:4]) == 0
        assert visca.decode_signed(data[4:]) == -828

    @pytest.mark.parametrize(
        ("body", "code", "word"),
        [
            (b"906002FF", 0x02, "syntax"),
            (b"906003ff", 0x03, "buffer"),
            (b"906104FF", 0x04, "cancelled"),
            (b"906005FF", 0x05, "socket"),
            (b"906141FF", 0x41, "not executable"),
            (b"906077FF", 0x77, "77"),
        ],
    )
    def test_error_messages(self, body, code, word):
        for read in (visca.messages, lambda b: visca.answer(b, 4)):
            with pytest.raises(visca.ViscaError, match=word) as caught:
                read(body)
            assert caught.value.code == code

    def test_acknowledgement_and_completion_pass(self):
        assert visca.messages(b"9041FF9051FF") == [b"\x90\x41", b"\x90\x51"]
        assert visca.messages(b"") == []

    @pytest.mark.parametrize(
        "body",
        [
            b"",
            b"<html>Error</html>",
            b"9050",
            b"905",
            b"90500000000",
            b"9050000000ff",
            b"90501f000000ff",
            b"9041ff",
            b"\xff\xd8\xff",
            b"9050000000000f0c0c04ff",
        ],
    )
    def test_anything_else_is_no_zoom_answer(self, body):
        with pytest.raises(visca.ViscaError) as caught:
            visca.answer(body, 4)
        assert caught.value.code is None

    @given(st.binary(max_size=40) | st.text("0569fF \n", max_size=40).map(str.encode))
    def test_only_its_own_error_for_any_bytes(self, body):
        try:
            data = visca.answer(body, 8)
        except visca.ViscaError as error:
            length = len(str(error))
        else:
            length = len(data)
        assert 8 <= length < 400
