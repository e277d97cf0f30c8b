"""VISCA as cameras speak it inside HTTP: hex text, one nibble per byte, FF ends a message."""

_ERRORS = {
    0x02: "syntax error: it does not know this command",
    0x03: "command buffer full",
    0x04: "command cancelled",
    0x05: "no such socket",
    0x41: "command not executable in its present state",
}
BUFFER_FULL, NOT_EXECUTABLE = 0x03, 0x41


class ViscaError(ValueError):
    """A reply that is no VISCA answer (code None), or a VISCA error message (its code)."""

    def __init__(self, text: str, code: int | None = None) -> None:
        super().__init__(text)
        self.code = code


def encode_signed(value: int) -> str:
    """A signed 16-bit integer as four nibbles in two's complement, ``0y0y0y0y``, upper case.

    Raises ValueError outside -32768..32767.
    """
    if not -0x8000 <= value <= 0x7FFF:
        raise ValueError(f"{value} does not fit into 16 bits")
    return encode_unsigned(value & 0xFFFF)


def encode_unsigned(value: int) -> str:
    """An integer of 0..65535 as four nibbles, ``0p0q0r0s``, upper case. Raises ValueError."""
    if not 0 <= value <= 0xFFFF:
        raise ValueError(f"{value} does not fit into 16 bits")
    return "".join(f"0{digit}" for digit in f"{value:04X}")


def decode_unsigned(nibbles: bytes) -> int:
    """Bytes of one nibble each (as answer() gives them) as an integer >= 0."""
    value = 0
    for nibble in nibbles:
        value = value << 4 | nibble
    return value


def decode_signed(nibbles: bytes) -> int:
    """Four bytes of one nibble each as -32768..32767."""
    value = decode_unsigned(nibbles)
    return value - 0x10000 if value >= 0x8000 else value


def messages(body: bytes) -> list[bytes]:
    """Split a reply into its messages, without their closing FF; hex of either case, any spaces.

    Raises ViscaError for text that is no VISCA, and for the first error message among them.
    """
    try:
        data = bytes.fromhex(body.decode("ascii"))
    except ValueError:
        raise ViscaError(f"{_excerpt(body)} (no VISCA)") from None
    if data and data[-1] != 0xFF:
        raise ViscaError(f"{_excerpt(body)} (VISCA without its end)")
    found = data.split(b"\xff")[:-1]
    for message in found:
        if len(message) == 3 and message[1] >> 4 == 6:
            text = _ERRORS.get(message[2], f"error code {message[2]:02X}")
            raise ViscaError(f"VISCA {text} ({message.hex().upper()}FF)", message[2])
    return found


def answer(body: bytes, nibbles: int) -> bytes:
    """The data of the ``90 50 ... FF`` inquiry answer in a reply: ``nibbles`` bytes of 0..15.

    An acknowledgement before it is skipped. Raises ViscaError.
    """
    for message in messages(body):
        data = message[2:]
        if message[:2] == b"\x90\x50" and len(data) == nibbles and max(data) <= 0x0F:
            return data
    raise ViscaError(f"{_excerpt(body)}, not an answer of {nibbles} nibbles")


def _excerpt(body: bytes) -> str:
    return repr(body[:60].decode("ascii", errors="replace")) if body.strip() else "an empty body"
