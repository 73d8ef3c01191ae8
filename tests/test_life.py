"""A sensor's life keeps its peaks and tells when it softens."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from test_batch import NPZ, Denting

import torchmembrane as tm
from torchmembrane.live.peaks import Peaks
from torchmembrane.results.store import Mesh
from torchmembrane.stiffness import LEAST_DEVIATION, LEAST_OFF, MEMORY, SURE, StiffnessWatch
from torchmembrane.track import FOUND_PRESSURE_ERROR


def watched(ratios, known=2.0):
    watch = StiffnessWatch()
    for ratio in ratios:
        watch.add(ratio * known, known)
    return watch


def test_a_ratio_is_the_mean_of_the_latest_comparisons_weighted_by_their_certainty():
    watch = StiffnessWatch()
    watch.add(9.0, 1.0)
    for found, deviation in ((1.0, 0.0), (1.2, 2 * LEAST_DEVIATION), (1.0, 0.0), (1.0, 0.0)):
        watch.add(found, 1.0, deviation)
    assert watch.ratio == pytest.approx((3 * 1.0 + 1.2 / 4) / (3 + 1 / 4))  # the first is forgotten
    assert watch.deviation == pytest.approx(LEAST_DEVIATION / 3.25**0.5)


def test_a_calibration_is_due_beyond_a_least_change_and_beyond_chance():
    assert MEMORY == 4 and SURE * LEAST_DEVIATION / 2 < LEAST_OFF
    assert not watched([1.04] * 9).is_due and watched([1.06] * 4).is_due and watched([0.94] * 4).is_due
    assert not watched([1.08]).is_due and watched([1.1]).is_due  # one comparison is less certain
    assert not StiffnessWatch().is_due


def test_noise_of_a_sound_membrane_is_no_change():
    rng = np.random.default_rng(0)
    alarms = 0
    for _ in range(200):
        watch = StiffnessWatch()
        for ratio in 1 + 0.022 * rng.standard_normal(20):
            watch.add(ratio, 1.0)
            alarms += watch.is_due
    assert alarms <= 4  # of 4000


@pytest.fixture(scope="module")
def pressed(small_sensor, small_images):
    """A tracker that has seen a press of the small sensor."""
    sensor = tm.Sensor.from_file(small_sensor / "sensor.toml")
    reconstructor = tm.Reconstructor(sensor)
    return reconstructor, reconstructor.read(small_images[-1])


def test_a_softened_membrane_is_said_once_with_the_remedy(pressed):
    """The same press of a softer membrane takes less force than is found with the modulus of the file."""
    reconstructor, image = pressed
    tracker = tm.Tracker(reconstructor)
    result = tracker(image)
    tracker._latest_result = result._replace(force_deviation=0 * result.force)  # of this coarse grid forces are uncertain
    force = float(result.force.norm())
    with pytest.warns(UserWarning, match=r"loads are found 25 % too large.*softened.*calibrate material --weight") as said:
        for _ in range(5):
            assert tracker.weigh(0.8 * force) == pytest.approx(1.25)
    assert len(said) == 1


def test_a_gauge_tells_the_same_of_pressures(pressed):
    reconstructor, image = pressed
    tracker = tm.Tracker(reconstructor)
    change = float(tracker(image).pressure_change[0])
    with pytest.warns(UserWarning, match="stiffened"):
        for _ in range(5):
            assert tracker.gauge(1.25 * change) == pytest.approx(0.8)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_comparison_of_pressures_is_as_sure_of_a_fall_as_of_a_rise(pressed, sign):
    reconstructor, image = pressed
    tracker = tm.Tracker(reconstructor)
    result = tracker(image)
    change = sign * result.pressure_change.abs()
    tracker._latest_result = result._replace(pressure_change=change)
    assert tracker.gauge(float(change)) == pytest.approx(1.0)
    assert tracker.stiffness.deviation == pytest.approx(FOUND_PRESSURE_ERROR)


def test_a_load_that_tells_nothing_is_refused(pressed):
    reconstructor, image = pressed
    tracker = tm.Tracker(reconstructor)
    with pytest.raises(tm.MembraneError, match="no frame yet"):
        tracker.weigh(1.0)
    result = tracker(image)
    for wrong in (0.0, -1.0, np.nan, "1"):
        with pytest.raises(tm.MembraneError, match="the weight in N, positive"):
            tracker.weigh(wrong)
    tracker._latest_result = result._replace(contact_at_rim=torch.ones_like(result.contact_at_rim))
    with pytest.raises(tm.MembraneError, match="reaches the rim"):
        tracker.weigh(1.0)
    tracker._latest_result = result._replace(status=torch.tensor([8]))
    with pytest.raises(tm.MembraneError, match="not ok"):
        tracker.gauge(1.0)
    sensor = replace(reconstructor.sensor, material=replace(reconstructor.sensor.material, shear_modulus=None))
    reconstructor.sensor, before = sensor, reconstructor.sensor
    tracker._latest_result = result
    with pytest.raises(tm.MembraneError, match="shear_modulus and thickness"):
        tracker.weigh(1.0)
    reconstructor.sensor = before


@pytest.fixture
def frames():
    made = Denting()
    mesh = Mesh.from_reconstructor(made, NPZ)
    batch = made(torch.tensor([0.3, 0.9, 0.05, 0.0])[:, None, None, None].expand(4, 1, 12, 16))
    return mesh, [batch.frame(k) for k in range(4)]  # the third has not converged, the last has no surface


def test_peaks_are_the_largest_of_frames_to_rely_on(frames):
    mesh, given = frames
    peaks = Peaks(mesh)
    for frame in given:
        peaks.add(frame)
    assert peaks.frames == 2 and peaks.depth == pytest.approx(0.9, rel=1e-5) and peaks.force == pytest.approx(0.9 * 3**0.5)
    peaks.add(given[2] | {"force": np.full(3, 100.0)})
    assert peaks.force < 2 and peaks.said == "peaks of 2 frames: force 1.56 N, depth 0.9 mm"


def test_a_life_keeps_the_largest_of_all_streams(frames, tmp_path):
    mesh, given = frames
    for number, frame in ((0, given[1]), (1, given[0])):
        peaks = Peaks(mesh)
        peaks.add(frame)
        said = peaks.kept_in(tmp_path / "life.json")
        assert f"{number + 1} frames: force 1.56 N, depth 0.9 mm" in said
    assert json.loads((tmp_path / "life.json").read_text())["frames"] == 2
    with pytest.raises(tm.MembraneError, match="of a sensor with {'name': 'cap'}; expected"):
        Peaks(mesh._replace(name="other")).kept_in(tmp_path / "life.json")
    for text in ("no json", "[]", '{"force": -1, "depth": 0, "frames": 0, "since": "a"}'):
        (tmp_path / "life.json").write_text(text)
        with pytest.raises(tm.MembraneError, match="name another file"):
            Peaks(mesh).kept_in(tmp_path / "life.json")
