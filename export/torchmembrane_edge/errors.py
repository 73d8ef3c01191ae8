"""The error class of this package, and functions that format text for its messages."""


class EdgeError(ValueError):
    """Error whose message states what was given, what was expected, and the remedy."""


def printable(text: object) -> str:
    """Return a path's text in UTF-8; bytes that are not valid UTF-8 are escaped."""
    return str(text).encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def in_one_line(text: object) -> str:
    """Return a message, or content of a file, from elsewhere as one line of at most 200 characters."""
    line = "".join(c if c.isprintable() else "?" for c in " ".join(str(text).split())) or type(text).__name__
    return line if len(line) <= 200 else f"{line[:98]}...{line[-98:]}"
