"""Tables of errors: rows of cells, the first of which is the head, from the results of parts."""

Rows = list[list[str]]
SENSORS = {
    "dome15_fisheye": "dome, fisheye, far",
    "dome15_pinhole": "dome, pinhole, far",
    "dome15_port": "dome, through Plexiglas and water",
    "dome3_fisheye": "dome, fisheye, near",
    "finger_fisheye": "elliptic fingertip, fisheye",
    "halfcyl_fisheye": "half cylinder, fisheye",
}


def percent(value: float) -> str:
    """In per cent, below 2 % with one digit after the point.

    >>> percent(0.0132), percent(0.163)
    ('1.3 %', '16 %')
    """
    return f"{100 * value:.1f} %" if value < 0.02 else f"{100 * value:.0f} %"


ESTIMATORS = {
    "force balance": "**force balance**, the default",
    "the sensor's material": "minimum energy: the sensor's own material",
    "harmonic, triangles": "minimum energy: harmonic, triangles, exact volume",
    "the paper": "the paper (`--estimator paper`): harmonic, affine quadrilaterals, linear volume",
}
FORCE_BALANCE = {
    "surface: error over displacement, rms at the dots": ("force balance", percent),
    "contact point": ("force balance: contact", "{:.1f} mm".format),
    "force": ("force balance: force", percent),
    "pressure change": ("force balance: pressure_change", percent),
}


def default_accuracy(found: dict) -> Rows:
    """Errors of force balance in images with noise."""
    rows = [
        [name, *(text(value) for value in found["surface"][f"{key}, snr30"])] for name, (key, text) in FORCE_BALANCE.items()
    ]
    return [["", "median", "worst"], *rows]


def estimators(found: dict) -> Rows:
    """Errors of the surface over the displacement, for every estimator, in images with noise."""
    errors = {name: found["surface"][f"{label}, snr30"] for label, name in ESTIMATORS.items()}
    return [
        ["error of the surface over the displacement", "median", "worst"],
        *([name, f"{median:.2f}", f"{worst:.2f}"] for name, (median, worst) in errors.items()),
    ]


def marker_errors(found: dict) -> Rows:
    """Median and 95 % of the error of a dot's pixel, by sensor."""
    each = {(row["sensor"], row["images"]): f"{row['median']:.3f} / {row['p95']:.3f} px" for row in found["markers"]}
    return [
        ["sensor", "clean", "30 dB noise"],
        *([name, each[sensor, "clean"], each[sensor, "snr30"]] for sensor, name in SENSORS.items()),
    ]
