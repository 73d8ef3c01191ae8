"""Contents of a `state_dict`: the camera, the material and what depends on them; everything else is rebuilt from the sensor."""

from typing import Any

import torch
from torch import Tensor, nn

from .camera.model import Camera
from .errors import MembraneError
from .user_warnings import warn_user

OF_MATERIAL = ("prestretch", "c1", "c2", "rest_pressure", "rest_load")
STIFFNESS, FOLLOWING = ("c1", "c2"), ("rest_pressure", "rest_load")
"""Entries that identify the sensor, so that a difference is refused, and entries that are derived from the others."""
IDENTITY = "rest_markers"
"""The markers' rest positions `[D, 3]`: those of another sensor are refused."""
SAME_MARKERS = 1e-4  # largest distance between the rest markers of two states of one sensor, over the markers' extent


def drop_derived_buffers(module: nn.Module) -> None:
    """Leave those constants out of a module's `state_dict` that can be rebuilt from the sensor; added parameters are kept.

    A state that holds all constants can still be loaded: their shapes are checked, and the constants are ignored. A state with
    another prestretch or camera, which may have been learned, is loaded with a warning.

    Raises:
        MembraneError: later, when a loaded state belongs to another sensor, material or grid.
    """
    module.register_state_dict_post_hook(_leave_out)
    module.register_load_state_dict_pre_hook(_complete)


def _kept(module: nn.Module) -> set[str]:
    """Return the names of the buffers that are kept, each once."""
    camera = {f"{path}." for path, part in module.named_modules() if isinstance(part, Camera)}
    names = [name for name, _ in module.named_buffers()]
    return {
        name
        for name in names
        if name == IDENTITY or name.rpartition(".")[2] in OF_MATERIAL or any(name.startswith(path) for path in camera)
    }


def _leave_out(module: nn.Module, state: dict[str, Any], prefix: str, _: Any) -> None:
    kept = _kept(module)
    for name, _buffer in module.named_buffers(remove_duplicate=False):
        if name not in kept:
            state.pop(prefix + name, None)


def _complete(module: nn.Module, state: dict[str, Any], prefix: str, *_: Any) -> None:
    """Check a state, convert it to the module's precision and device, and add the missing constants as they are."""
    kept, others = _kept(module), []
    first = {id(buffer): name for name, buffer in reversed(list(module.named_buffers()))}
    for name, buffer in module.named_buffers(remove_duplicate=False):
        given = state.get(prefix + name)
        if given is not None and given.shape != buffer.shape:
            raise MembraneError(
                f"Reconstructor.load_state_dict: {name} {list(given.shape)}; expected {list(buffer.shape)}: it is the state of "
                "another sensor or grid; build the Reconstructor from that sensor's file"
            )
        if given is not None:
            given = state[prefix + name] = given.to(buffer)
        if name == IDENTITY and given is not None:
            _check_identity(given, buffer)
        elif given is not None and name in kept and not torch.allclose(given, buffer, rtol=SAME_MARKERS, atol=SAME_MARKERS**2):
            others.append(name)
        if first[id(buffer)] not in kept:
            state[prefix + name] = buffer
        elif name not in kept and prefix + first[id(buffer)] in state:
            state[prefix + name] = state[prefix + first[id(buffer)]]
    _check_others(others)


def _check_others(names: list[str]) -> None:
    """Given the names of the buffers that differ, refuse another stiffness and warn about another prestretch or camera."""
    last = [name.rpartition(".")[2] for name in names]
    if any(name in STIFFNESS for name in last):
        raise MembraneError(
            "Reconstructor.load_state_dict: the state is of another shear modulus or thickness than this sensor's; expected "
            "the state of this sensor: build the Reconstructor from that sensor's file"
        )
    if said := [name for name, end in zip(names, last, strict=True) if end not in FOLLOWING]:
        warn_user(
            f"Reconstructor.load_state_dict: {', '.join(said)} differ from this sensor's; the state's are used from now on",
        )


def _check_identity(given: Tensor, own: Tensor) -> None:
    off = torch.linalg.vector_norm(given - own, dim=-1).max()
    if off > SAME_MARKERS * torch.linalg.vector_norm(own.amax(0) - own.amin(0)):
        raise MembraneError(
            f"Reconstructor.load_state_dict: {IDENTITY} up to {float(off):.3g} off this sensor's; expected the state of this "
            "sensor: build the Reconstructor from that sensor's file"
        )
