"""The package's one exception type, and the checks that raise it."""

import functools
import inspect
import os
import reprlib
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TypeVar

Checked = TypeVar("Checked", bound=Callable[..., Any])
WORDS: dict[Any, str] = {
    **{float: "a number", int: "a whole number", bool: "True or False", str: "text", Path: "a path", NoneType: "None"},
    **{"Tensor": "a tensor or an array of numbers", "ndarray": "an array of numbers", "dtype": "a torch.dtype"},
}
"""Descriptions of types in messages, by the type or by its name."""


class MembraneError(ValueError):
    """An invalid file, value or shape; the message says what was given, what was expected and how to correct it.

    Example:
        >>> from torchmembrane.surface.shapes import spherical_cap
        >>> spherical_cap(rim_radius=12.0, height=-1.0, base_z=5.0)
        Traceback (most recent call last):
        ...
        torchmembrane.errors.MembraneError: spherical_cap: height = -1.0; expected a finite positive number, from 1e-06 to 1e+06
    """


def expect(right: bool, name: str, value: object, expected: str) -> None:
    """Raise an error unless a condition on a value holds.

    Args:
        right: whether the value is valid.
        name: the value's name at the caller.
        value: the value that was given.
        expected: what is accepted, and how to correct it.

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


def check_arguments(target: Checked) -> Checked:
    """Decorate a public function or class so that its arguments are checked against their annotations.

    A number is anything that Python accepts as a number, a list is any sequence, and an array is anything that numpy converts
    to an array of numbers. For a missing or misnamed argument, Python raises its own error.

    Args:
        target: the function or class to decorate.

    Returns:
        The decorated function, which raises `MembraneError` for an argument of the wrong type; of a class, the class itself.

    Example:
        >>> @check_arguments
        ... def scaled(values: list[float], factor: float = 1.0) -> list[float]:
        ...     return [factor * value for value in values]
        >>> scaled([1, 2.5], 2)
        [2, 5.0]
        >>> scaled([1, "b"])
        Traceback (most recent call last):
        ...
        torchmembrane.errors.MembraneError: scaled: values is [1, 'b']; expected a list of numbers
    """
    if isinstance(target, type):
        target.__init__ = check_arguments(target.__init__)  # type: ignore[misc]
        return target
    signature, title = inspect.signature(target), target.__qualname__.removesuffix(".__init__")

    @functools.cache
    def hints() -> dict[str, Any]:
        try:
            return typing.get_type_hints(target)
        except NameError:  # of what is imported for types only
            return {name: hint for name, hint in target.__annotations__.items() if not isinstance(hint, str)}

    @functools.wraps(target)
    def called(*arguments: Any, **options: Any) -> Any:
        for name, value in _given(signature, arguments, options):
            if name in hints() and not _fits(value, hints()[name]):
                raise MembraneError(f"{title}: {name} is {_shown(value)}; expected {_in_words(hints()[name])}")
        return target(*arguments, **options)

    return typing.cast(Checked, called)


def _given(signature: inspect.Signature, arguments: tuple[Any, ...], options: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the names and values of a call's arguments that differ from their defaults; nothing if Python rejects the call."""
    try:
        bound = signature.bind(*arguments, **options).arguments
    except TypeError:
        return
    for name, value in bound.items():
        parameter = signature.parameters[name]
        if parameter.kind is parameter.VAR_POSITIONAL:
            yield from ((name, each) for each in value)
        elif parameter.kind is not parameter.VAR_KEYWORD and value is not parameter.default:
            yield name, value


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a value has the type of an annotation, or is accepted in its place."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return True
    if origin in (typing.Union, UnionType):
        return any(_fits(value, each) for each in inner)
    if origin is type:
        return isinstance(value, type)
    if origin is tuple and Ellipsis not in inner:
        return _is_list(value) and len(value) == len(inner) and all(map(_fits, value, inner))
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return isinstance(value, Mapping)
    if isinstance(origin, type) and issubclass(origin, Iterable):
        return _is_list(value) and all(_fits(each, inner[0]) for each in value)
    if origin is typing.Literal:
        return any(value is each or (type(value) is type(each) and value == each) for each in inner)
    if origin is not None or not isinstance(hint, type) or getattr(hint, "_is_protocol", False):
        return callable(value) or origin is not Callable
    return _is_plain(value, hint)


def _is_plain(value: Any, kind: type) -> bool:
    if kind is float:
        return is_number(value)
    if kind is int:
        return is_number(value) and float(value).is_integer()
    if kind is bool:
        return type(value).__name__ == "bool"  # numpy's too
    if kind is Path:
        return isinstance(value, os.PathLike)
    if kind.__name__ in ("ndarray", "Tensor"):
        return is_array(value)
    return isinstance(value, kind)


def _is_list(value: Any) -> bool:
    is_sized = isinstance(value, Iterable) and hasattr(value, "__len__") and getattr(value, "shape", None) != ()
    return is_sized and not isinstance(value, str | bytes | Mapping)


def is_number(value: Any) -> bool:
    """Return whether Python accepts a value as a real number; arrays and tensors without axes are included."""
    if getattr(value, "shape", None) not in (None, ()) or isinstance(value, str | bytes):
        return False
    try:
        float(value)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        return False
    return True


def is_array(value: Any) -> bool:
    """Return whether a value is a tensor of real numbers, or can be converted to an array of real numbers by numpy."""
    import numpy as np

    if hasattr(value, "is_complex"):
        return not value.is_complex()
    try:
        return np.asarray(value).dtype.kind in "biuf"
    except (TypeError, ValueError, OverflowError, RuntimeError):
        return False


def _shown(value: Any) -> str:
    """Return a short description of a value in one line: the shape of an array, the type of an object."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{type(value).__name__} {list(value.shape)} of {value.dtype}"
    if value is None or isinstance(value, bool | int | float | complex | str | bytes | list | tuple | dict):
        return " ".join(reprlib.repr(value).split())
    return f"a {type(value).__name__}"


def _in_words(hint: Any) -> str:
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, UnionType):
        return " or ".join(dict.fromkeys(map(_in_words, inner)))
    if origin is typing.Literal:
        return " or ".join(map(repr, inner))
    if origin is tuple and Ellipsis not in inner:
        return f"{len(inner)} values, {', '.join(map(_in_words, inner))}"
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return "a dict"
    if isinstance(origin, type) and issubclass(origin, Iterable):
        return f"a list of {_in_words(inner[0]).removeprefix('a ').removeprefix('an ')}s"
    if origin is type:
        return f"a subclass of {inner[0].__name__}"
    name = getattr(hint, "__name__", str(hint))
    return WORDS.get(hint) or WORDS.get(name) or f"a {name}"
