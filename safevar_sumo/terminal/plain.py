"""Text of a user's as it is: no markup, no control characters."""

from __future__ import annotations

from rich.text import Text


def plain(text: object, style: str = "") -> Text:
    """For a rich table or line; what cannot be printed becomes a question mark, or a space if it is one."""
    return Text("".join(sign if sign.isprintable() else " " if sign.isspace() else "?" for sign in str(text)), style)
