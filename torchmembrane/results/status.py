"""The status of a frame."""

from enum import IntEnum


class Status(IntEnum):
    """The outcome of a frame's reconstruction; results store its value, and `text` is the message.

    Example:
        >>> Status(4).name, Status.OK.text
        ('BLANK', 'ok')
        >>> Status.NOT_CONVERGED.has_surface, Status.BLANK.has_surface
        (True, False)
    """

    text: str

    def __new__(cls, value: int, text: str = "") -> "Status":
        status = int.__new__(cls, value)
        status._value_, status.text = value, text
        return status

    OK = 0, "ok"
    TOO_FEW_MARKERS = 1, "too few markers found: check light, focus and polarity; no surface"
    UNLIKE_REST = 2, "image unlike the rest image (most markers not found): is it this sensor's? no surface"
    NOT_CONVERGED = 3, "the solve has not converged: the answer is kept, do not rely on it"
    BLANK = 4, "blank or saturated image: no contrast; no surface"
    BAD_VALUES = 5, "image holds NaN, infinity or values outside 0..1; no surface"
    NO_SOLUTION = 6, "the solve broke down: the flow folds the surface or is far too large; no surface"
    UNEXPLAINED = (
        7,
        "the markers move as no surface of this sensor does: look at the rest image first (has the camera moved since?), then "
        "at the rest shape, then at the camera; do not rely on it",
    )
    HIDDEN = 8, "a part of the membrane is hidden: the answer is kept, there it is a guess"
    OUT_OF_RANGE = 9, "beyond the range in which this sensor's answers were shown right: the answer is kept, do not rely on it"
    VIEW_LEFT_OUT = 10, "a view shows too little (blank, blurred or another scene) and was left out: the answer is the others'"

    @property
    def has_surface(self) -> bool:
        """Return whether the frame keeps its surface; other frames are NaN."""
        return self in (Status.OK, Status.NOT_CONVERGED) or self >= Status.UNEXPLAINED
