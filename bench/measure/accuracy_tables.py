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


def default_errors(*parts: dict) -> Rows:
    """Of force balance, in images with noise: median and worst, for every set of presses."""
    rows = {
        "surface: error over displacement, rms at the dots": ("force balance", percent),
        "contact point": ("force balance: contact", "{:.1f} mm".format),
        "force": ("force balance: force", percent),
        "pressure change": ("force balance: pressure_change", percent),
    }
    return [
        [name, *(text(value) for part in parts for value in part["surface"][f"{key}, snr30"])]
        for name, (key, text) in rows.items()
    ]


def default_accuracy(independent: dict) -> Rows:
    return [["", "median", "worst"], *default_errors(independent)]


def marker_errors(*parts: dict) -> Rows:
    """Median and 95 % of the error of a dot's pixel, by sensor, for every set of presses."""
    found = [{(row["sensor"], row["images"]): row for row in part["markers"]} for part in parts]
    kinds = ("clean", "snr30")
    cells = {
        sensor: [f"{each[sensor, kind]['median']:.3f} / {each[sensor, kind]['p95']:.3f} px" for each in found for kind in kinds]
        for sensor in SENSORS
    }
    return [["sensor", *["clean", "30 dB noise"] * len(parts)], *([SENSORS[sensor], *row] for sensor, row in cells.items())]
