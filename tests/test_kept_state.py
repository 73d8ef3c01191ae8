"""Laws of what a `state_dict` keeps: states of earlier versions hold constants that are gone, and are loaded all the same."""

import torch
from torch import nn

import torchmembrane as tm


def test_states_of_earlier_versions_are_loaded_without_the_constants_that_are_gone():
    """Alone and as a part of a module."""
    sensor = tm.preset("fingertip")
    gone = {"marker_vertices": torch.zeros(4, 3, dtype=torch.int64), "marker_weights": torch.zeros(4, 3)}
    state = tm.Reconstructor(sensor, "minimum-energy").state_dict() | gone
    fresh = tm.Reconstructor(sensor, "minimum-energy")
    fresh.load_state_dict(state)
    nn.Sequential(fresh).load_state_dict({f"0.{name}": value for name, value in state.items()})
