"""What a dialect is asked and what it answers."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Request:
    method: str
    path: str  # unquoted, without the query
    parameters: dict[str, str] = field(default_factory=dict)  # lower-case names; query, form body
    query: str = ""  # as it came
    body: bytes = b""
    headers: dict[str, str] = field(default_factory=dict)  # lower-case names


@dataclass(frozen=True)
class Reply:
    status: int
    body: bytes = b""
    content_type: str = "text/plain"
    with_length: bool = True  # False: the body ends where the connection does
    headers: tuple[tuple[str, str], ...] = ()
    length: int | None = None  # what Content-Length says; None: the truth
