"""What tests keep is made anew when its source has changed."""

import kept
import numpy as np
import pytest


@pytest.fixture
def made(tmp_path, monkeypatch):
    """Counts how often it is made."""
    monkeypatch.setattr(kept, "FOLDER", tmp_path)
    calls = []

    def make():
        calls.append(1)
        return {"x": np.array([len(calls)])}

    return lambda parameters: int(kept.kept("press", parameters, make)["x"][0])


def test_what_is_kept_is_made_once(made):
    assert [made("a"), made("a")] == [1, 1]


def test_other_parameters_are_made_anew_and_the_old_is_gone(made, tmp_path):
    assert [made("a"), made("b"), made("b")] == [1, 2, 2]
    assert len(list(tmp_path.glob("press-*.npz"))) == 1


def test_other_sources_are_made_anew(made, monkeypatch):
    assert made("a") == 1
    monkeypatch.setattr(kept, "sources", lambda: b"changed")
    assert made("a") == 2
