"""The Python of docs/live.md runs and does what it says."""

import re
from pathlib import Path

import pytest
import torch

import torchmembrane as tm

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def followed():
    names: dict = {}
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "live.md").read_text(), re.S)
    with (
        pytest.MonkeyPatch.context() as patch,
        pytest.warns(UserWarning, match=r"1.00 px \(rms\) off the rest image.*a moved camera's: 1.0, 0.0 px") as said,
    ):
        patch.chdir(ROOT)
        exec(compile(code, "live.md", "exec"), names)
    assert len(said) == 1
    return names


def test_a_dark_frame_has_no_force_and_the_next_press_is_found_as_from_rest(followed):
    forces, reconstructor, press = (followed[name] for name in ("forces", "reconstructor", "press"))
    assert list(forces) == [0.0, 0.03, 0.17] and forces[0.0].norm() < 1e-3
    with torch.no_grad():
        from_rest = reconstructor(press).force[0]
    torch.testing.assert_close(forces[0.17], from_rest)
    torch.testing.assert_close(forces[0.03], from_rest, rtol=0.01, atol=0.02)


def test_the_drift_is_the_camera_s_motion_and_is_nulled(followed):
    tracker, result = followed["tracker"], followed["result"]
    assert followed["aged"] == pytest.approx(1.0, abs=0.01) and tracker.drift == 0
    assert tm.Status(int(result.status[0])) == tm.Status.OK and result.force.norm() < 1e-3
    assert tracker.time == pytest.approx(19 / 30)
