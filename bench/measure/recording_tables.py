"""Tables and paragraphs on real sensors, from published recordings that are not distributed."""

from bench.measure.accuracy_tables import Rows

LEVERS = {
    "no height": "no `height`",
    "height": "`height = 3.0`",
    "height, liquid": 'the same, `filling = "liquid"`',
    "height, liquid, prestretch 1.3": "the same, and a prestretch of 1.3",
}


def tactip(found: dict) -> Rows:
    """Pins found, statuses and depths of a TacTip, by the height of the pins in its file."""
    rows = []
    for row in found["tactip"]["heights"]:
        name = f"{row['height']:g} mm" if row["height"] else "none"
        pins = f"all {found['tactip']['pins']} in {row['all_found']} of {row['photographs']}"
        ok = f"{row['statuses'].get('0', 0)} of {row['photographs']}"
        rows.append([name, f"{row['rest']['found']}", pins, ok, f"{row['depth']:.1f} mm"])
    return [["`height` in the file", "pins found at rest", "in presses", "status ok", "deepest point, median"], *rows]


def finger(found: dict) -> str:
    """Pins found, statuses and errors of the finger with a thick skin."""
    of, alone, tracked = found["finger"], found["finger"]["alone"], found["finger"]["tracked"]
    found_in, near_in = (min(each[key] for each in (alone, tracked)) for key in ("fewest_found", "fewest_near"))
    astray, farthest = {*alone["astray"], *tracked["astray"]}, max(each["farthest_px"] for each in (alone, tracked))
    low, _, high = alone["error"]
    others = ", ".join(f"{count} with {name}" for name, count in of["ok_by_file"].items())
    return (
        f"For {of['frames']} of its photographs, the positions of the pins are known from stereo with two mirrors. At least "
        f"{found_in} of {alone['pins']} pins are found in each frame, with and without tracking, and at least {near_in} of "
        f"them lie within 1 px of the stereo positions. The others, always among the same {len(astray)} pins, are up to "
        f"{farthest:.1f} px off. Status ok is given to {alone['statuses_at_rest'].get('0', 0)} of the "
        f"{of['at_rest']} frames in which no pin moves by more than the stereo's noise, and to "
        f"{alone['statuses_moving'].get('0', 0)} of the {of['moving']} others, of which "
        f"{alone['statuses_moving'].get('7', 0)} have status 7. In these, the error of the surface is {low:.1f} to {high:.1f} "
        f"times the motion of the pins. With another number in the file, status ok is given to so many of the {of['moving']} "
        f"frames: {others}."
    )


def finger_levers(found: dict) -> Rows:
    """Errors and statuses of the finger with its pins as levers."""
    count, rows = found["levers"]["frames"], []
    for row in found["levers"]["files"]:
        wrong = str(row["wrong"]) if row["ok"] else ""
        rows.append([LEVERS[row["file"]], f"{row['error']:.2g}", f"{row['ok']} of {count}", wrong])
    return [["file", "error, median", "status ok", "of these off by over a quarter"], *rows]


def bubble_surface(found: dict) -> str:
    """Errors of the real bubble's surface against a depth camera."""
    of = balanced(found)
    return (
        f"On a **real** air-filled bubble, {of['contact']} photographs of a poke up to {of['depth']:.1f} mm deep were compared "
        f"with a depth camera. The rms error over the whole surface is {of['rms_contact']:.2f} mm. For comparison, the error "
        f"of a surface without any displacement would be {of['none_contact']:.2f} mm, and the depth camera's own noise is "
        f"{of['none_before']:.3f} mm. While the poke is held still, the depth of the deepest point is within "
        f"{100 * abs(of['deepest']):.0f} % of that of the depth camera, and its position within {of['away']:.0f} px. "
        f"{of['ok']} of the {of['frames']} photographs have status ok."
    )


def bubble_summary(results: dict) -> dict:
    """Results without the rows of single frames, and the largest depth."""
    surface = [
        {key: value for key, value in each.items() if key != "rows"} | dict(depth=max(r["camera_depth"] for r in each["rows"]))
        for each in results["surface"]
    ]
    held = {key: value for key, value in results["held"].items() if key != "forces"}
    return results | dict(surface=surface, held=held, poke=dict(rms=results["poke"]["rms"]))


def balanced(found: dict) -> dict:
    """Results of force balance."""
    return next(each for each in found["surface"] if each["estimator"] == "force balance")


def bubble_estimators(found: dict) -> Rows:
    """Errors of the real bubble's surface, by estimator."""
    from bench.measure.accuracy_tables import ESTIMATORS

    rows = [[ESTIMATORS[each["estimator"]], f"{each['rms_contact']:.2f} mm"] for each in reversed(found["surface"])]
    return [["", "rms error of the bubble's surface"], *rows, ["no displacement", f"{balanced(found)['none_contact']:.2f} mm"]]


def bubble_forces(found: dict) -> Rows:
    """Forces of the real bubble over the robot's, by what its file says."""
    rows = []
    for row in found["force"]:
        ratios = ["none" if row[of] is None else f"{row[of]['ratio']:.2f}" for of in ("by_rise", "by_force")]
        outside = ["-" if row[of] is None else f"{row[of]['outside']:.0f}" for of in ("by_rise", "by_force")]
        rows.append([row["changed"].replace("cm3", "cm³"), *ratios, ", ".join(outside)])
    last = "pressure of the air outside if the rise is right, if the force is right, hPa"
    return [
        ["changed", "force over the robot's, if the rise is right", "rise over the gauge's, if the force is right", last],
        *rows,
    ]


def bubble_gauge(found: dict) -> str:
    """Forces of the real bubble from its gauge at rest alone, and from one known force."""
    ratios = ", ".join(f"{ratio:.2f} with {pressure} hPa" for pressure, ratio in found["outside"].items())
    return (
        f"From the gauge at rest alone, with the prestretch of the file, the force over the robot's depends on the pressure of "
        f"the air outside: {ratios}. With the force of one photograph known, the rms difference from the robot's forces over "
        f"the poke is {found['poke']['rms']:.2f} N, of {found['held']['force']:.2f} N."
    )
