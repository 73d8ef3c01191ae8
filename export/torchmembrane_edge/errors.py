"""The error of this package, and text for its messages."""


class EdgeError(ValueError):
    """What came, what was expected, and the remedy."""


def printable(text: object) -> str:
    """A path's text in UTF-8: bytes that are none are written out."""
    return str(text).encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def in_one_line(text: object) -> str:
    """What something says, of at most 200 characters in one line: others' messages, and what others' files hold."""
    line = "".join(c if c.isprintable() else "?" for c in " ".join(str(text).split())) or type(text).__name__
    return line if len(line) <= 200 else f"{line[:98]}...{line[-98:]}"
