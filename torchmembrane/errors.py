"""The one exception family of torchmembrane, and the check that raises it."""


class MembraneError(ValueError):
    """A wrong file, value or shape; the message says what came, what was expected and the remedy.

    Example:
        >>> from torchmembrane.surface.shapes import spherical_cap
        >>> spherical_cap(rim_radius=12.0, height=-1.0, base_z=5.0)
        Traceback (most recent call last):
        ...
        torchmembrane.errors.MembraneError: spherical_cap: height = -1.0; expected a finite positive number, from 1e-06 to 1e+06
    """


def expect(right: bool, name: str, value: object, expected: str) -> None:
    """Refuse a value that is not right.

    Args:
        right: whether it is.
        name: what the value is called where the caller gave it.
        value: what came.
        expected: what is accepted, and the remedy.

    Raises:
        MembraneError: `right` is false.

    Example:
        >>> expect(1.3 >= 1, "prestretch", 1.3, "1 (unstretched) or more")
        >>> expect(0.9 >= 1, "prestretch", 0.9, "1 (unstretched) or more")
        Traceback (most recent call last):
        ...
        torchmembrane.errors.MembraneError: prestretch is 0.9; expected 1 (unstretched) or more
    """
    if not right:
        raise MembraneError(f"{name} is {value!r}; expected {expected}")
