"""Heights of markers are kept, checked, and refused where none fit."""

import numpy as np
import pytest
from pinned_cap import cap

import torchmembrane as tm
from torchmembrane.calibrate.material import material_from_pixels
from torchmembrane.calibrate.rest import rest_from_image
from torchmembrane.cli.describe import described
from torchmembrane.errors import MembraneError
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.simulate import Simulator


@pytest.mark.parametrize("height", [2.0, np.linspace(0.5, 2.0, 49)], ids=["all", "each"])
def test_the_file_keeps_heights(height, tmp_path):
    sensor = cap(height)
    again = Sensor.from_file(sensor.to_file(tmp_path))
    np.testing.assert_array_equal(again.markers.height, height)
    assert again.fingerprint == sensor.fingerprint != cap(0.0).fingerprint
    assert any("stand off the inner side by" in line for line in described(sensor, None, None))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("height = 2.0", 'height = "2"', "height = \"2\"; expected a finite number"),
        ("height = 2.0", "height = -2.0", "expected 0 or more, along the inward normal"),
        ("height = 2.0", "height = 9.0", "at most"),
        ('kind = "dots"', 'kind = "texture"', "none for texture"),
    ],
)  # fmt: skip
def test_a_wrong_height_is_refused_in_words(old, new, said, tmp_path):
    path = cap(2.0).to_file(tmp_path)
    text = path.read_text()
    head, table, rest = text.partition("[markers]")
    assert old in rest
    path.write_text(head + table + rest.replace(old, new))
    with pytest.raises(MembraneError, match=str(path)) as caught:
        Sensor.from_file(path)
    assert said in str(caught.value)


def test_heights_are_given_once(tmp_path):
    path = cap(np.linspace(0.5, 2.0, 49)).to_file(tmp_path)
    path.write_text(path.read_text().replace('kind = "dots"', 'kind = "dots"\nheight = 1.0'))
    with pytest.raises(MembraneError, match="has a column of that name: remove one of them"):
        Sensor.from_file(path)
    dots = tmp_path / "sensor_dots.csv"
    dots.write_text(dots.read_text().replace(",0.5\n", ",-0.5\n"))
    with pytest.raises(MembraneError, match="line 2: height = -0.5; expected 0 or more"):
        Sensor.from_file(path)
    with pytest.raises(MembraneError, match="an array of 49, one for each listed dot"):
        cap(np.ones(3))


def test_what_takes_no_heights_says_so():
    sensor = Simulator(cap(1.5), radii=(0.25, 0.3)).at_rest()
    for name in ("minimum-energy", "paper"):
        with pytest.raises(MembraneError, match=f"height of the markers for {name} is 1.5; expected 0, markers on the surface"):
            tm.Reconstructor(sensor, name)
    with pytest.raises(MembraneError, match="calibrate rest: height of the markers is 1.5"):
        rest_from_image(sensor, sensor.markers.rest_image)
    with pytest.raises(MembraneError, match="calibrate material: height of the markers is 1.5"):
        material_from_pixels(sensor, np.zeros((1, 49, 2)))
