"""Measured tables in the documents are those that their records give."""

import json
import re
import subprocess
from pathlib import Path

import pytest

from bench.measure import measure, pages
from bench.measure.calibration_tables import WEIGHED
from bench.measure.parts import PARTS, Part, words
from bench.measure.range_tables import PINS, readme_range
from bench.measure.tables import FIGURES, SUMMARIES, TABLES

IDENTITY = ("-c", "user.name=A", "-c", "user.email=a@b.c")
IN_PAGES = {(page.name, name): text for page in pages.PAGES for name, text in pages.blocks(page.read_text()).items()}


@pytest.mark.parametrize("page, name", IN_PAGES)
def test_a_table_in_a_page_is_the_one_of_its_record(page, name):
    assert IN_PAGES[page, name] == pages.block(*TABLES[name])


def test_every_table_and_record_is_in_a_page():
    assert {name for _, name in IN_PAGES} == set(TABLES)
    used = {part for parts, _ in TABLES.values() for part in parts}
    assert {path.stem for path in pages.RECORDS.glob("*.json")} == used and used <= set(PARTS)
    assert {part for part, _ in FIGURES.values()} <= used


def test_a_marker_that_does_not_end_is_noticed():
    for page in pages.PAGES:
        text = page.read_text()
        assert len(re.findall("<!-- measured: ", text)) == len(re.findall("<!-- end of ", text)) == len(pages.blocks(text))


@pytest.mark.parametrize("name", PARTS)
def test_what_a_part_measures_exists(name):
    part = PARTS[name]
    assert not [path for path in part.paths if not (pages.ROOT / path).exists()]
    assert (part.data is None) == (words(part.command, "out") == part.command.split())


@pytest.mark.parametrize("path", sorted(pages.RECORDS.glob("*.json")), ids=lambda path: path.stem)
def test_a_record_says_where_it_comes_from(path):
    found = json.loads(path.read_text())
    assert re.fullmatch("[0-9a-f]{7}", found["revision"]) and re.fullmatch(r"2\d{3}-\d\d-\d\d", found["date"])
    assert re.match(r"(\.venv-ros/bin/)?python -m bench\.", found["command"]) and (
        found["seconds"] is None or found["processor"]
    )


def test_numbers_of_another_record_change_the_table(monkeypatch):
    """What is written by hand into a page does not survive, and is noticed."""
    page = "<!-- measured: training -->\nby hand\n<!-- end of training -->\n"
    made = pages.block(*TABLES["training"])
    assert pages.blocks(pages.filled(page, {"training": made})) == {"training": made} != {"training": "by hand"}
    faster = pages.record("training")
    faster["results"]["rows"][0]["ratio"] = 77.7
    monkeypatch.setattr(pages, "record", lambda part: faster)
    assert "77.7" in pages.block(*TABLES["training"]) and "77.7" not in made


@pytest.fixture
def commit(tmp_path, monkeypatch):
    """Commits a change of one file to a repository of its own; gives the revision."""
    monkeypatch.setattr(pages, "ROOT", tmp_path)

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", *IDENTITY, *words], cwd=tmp_path, check=True, capture_output=True, text=True
        ).stdout.strip()

    def change(name: str, added: str = "changed = 1") -> str:
        with (tmp_path / name).open("a") as file:
            file.write(added + "\n")
        git("add", name)
        git("commit", "--quiet", "--message", name)
        return git("rev-parse", "--short", "HEAD")

    git("init", "--quiet")
    return change


def test_a_table_says_that_it_is_old_once_its_paths_change(commit, tmp_path):
    measured = commit("measured.py")
    page = f"<!-- measured: a -->\n| 1 |\n\n*Measured at revision {measured}, 2026-11-27, A: `b`*\n<!-- end of a -->"
    commit("other.py")
    for path, said in (("other.py", "1 later commits"), ("measured.py", None)):
        aged = pages.aged(page, {"a": (path,)})
        assert aged.startswith(page) and (said in aged if said else aged == page)
    (tmp_path / "measured.py").write_text("not committed")
    assert pages.uncommitted(("measured.py", "other.py")) == ["measured.py"]
    assert pages.changes_since("0000000", ("measured.py",)) == []


def test_a_table_is_old_if_statements_have_changed_but_not_if_texts_have(commit, tmp_path):
    first = commit("a.py", "def f():\n    return 1")

    def is_old() -> bool:
        forget()
        return bool(pages.changes_since(first, ("a.py", "b.txt")))

    for said in ("# why", '"""What it is."""', ""):
        commit("a.py", said)
        assert not is_old()
    commit("a.py", 'def g():\n    """What it does."""\n    return f() + 1')
    assert is_old()
    (tmp_path / "a.py").write_text("def f():\n    'One.'\n    return (1)\n")
    commit("a.py", "")
    assert not is_old()
    commit("a.py", "def h():\n    raise ValueError('no')")
    second = commit("a.py", "")
    source = (tmp_path / "a.py").read_text()
    for words_of_error, raises in (("what was expected", "ValueError"), ("no", "TypeError")):
        (tmp_path / "a.py").write_text(source.replace("ValueError('no')", f"{raises}({words_of_error!r})"))
        commit("a.py", "")
        forget()
        assert bool(pages.changes_since(second, ("a.py",))) == (raises == "TypeError")
    third = commit("a.py", "def refusal():\n    return ValueError('no')")
    (tmp_path / "a.py").write_text(
        (tmp_path / "a.py").read_text().replace("return ValueError('no')", "return ValueError('yes')")
    )
    commit("a.py", "")
    forget()
    assert not pages.changes_since(third, ("a.py",))
    commit("b.txt", "# other files count as they are")
    assert is_old()


def forget() -> None:
    """Let git be asked again: another commit is the last one."""
    pages.changes_since.cache_clear()
    pages.program.cache_clear()


MADE = """
import json, os, sys
machine = dict(processor=os.environ["PROCESSOR"], torch="2.13")
json.dump(dict(machine=machine, rows=[dict(ms=1.2345678, each=[1, 2])]), open(sys.argv[sys.argv.index("--json") + 1], "w"))
"""


def recorded_in(folder: Path, monkeypatch: pytest.MonkeyPatch, part: Part) -> None:
    """Let one part, `made`, be measured in a folder."""
    for name, value in dict(ROOT=folder, RECORDS=folder / "records", OUT=Path("out")).items():
        monkeypatch.setattr(measure, name, value)
    monkeypatch.setattr(pages, "RECORDS", folder / "records")
    monkeypatch.setattr(measure, "PARTS", {"made": part})
    monkeypatch.setenv("PROCESSOR", "A")
    (folder / "made.py").write_text(MADE)
    (folder / "out").mkdir()


def test_a_part_leaves_a_record_of_what_was_measured_where_and_when(commit, tmp_path, monkeypatch):
    recorded_in(tmp_path, monkeypatch, Part("made --turns 5", ()))
    with pytest.raises(SystemExit, match=r"commit made\.py first"):
        measure.measure("made", {})
    assert measure.is_due("made") and measure.state("made") == "never measured"
    revision = commit("made.py")
    measure.measure("made", {})
    found = pages.record("made")
    assert found["command"] == "python -m made --turns 5" and found["revision"] == revision and found["processor"] == "A"
    assert found["results"] == {"rows": [{"ms": 1.2346, "each": [1, 2]}]}
    assert not measure.is_due("made") and measure.state("made").endswith("; current")
    later = commit("made.py")
    forget()
    assert later != revision and measure.is_due("made") and "old: 1 commits" in measure.state("made")


def test_the_latest_results_of_other_processors_are_kept(commit, tmp_path, monkeypatch):
    recorded_in(tmp_path, monkeypatch, Part("made", (), by_processor=True))
    revisions = {}
    for processor in "ABA":
        monkeypatch.setenv("PROCESSOR", processor)
        revisions[processor] = commit("made.py", f"# {len(revisions)}")
        measure.measure("made", {})
    found = pages.record("made")
    assert found["processor"] == "A" and list(found["results"]) == ["A", "B"]
    assert {name: each["revision"] for name, each in found["results"].items()} == revisions
    assert found["results"]["B"]["rows"] == [{"ms": 1.2346, "each": [1, 2]}]


def drifts(part, **of):
    return [dict(part=part, said=9, drift=0.2, contacts=0, early=False, kind="sags") | of]


PRESS = dict(kind="press", width=2.0, at_rim=False, surface=0.1, force=0.1)
ABOUT = dict(filling="gas", prestretch=1.05, dots=90, markers="dots", seen=1.0, clear=0.3)
THREE = (0, 0.01, 0.1), (0, 0.15, 0.9), (9, 0.25, 0.1)  # status, depth and error: right, wrong with ok, right with a status
RAW = {
    "drift": dict(
        rows=[dict(part="noise", frames=20100, alarms=0, certainty=-2.5), dict(part="touch", said=False)]
        + [row for part in ("jump", "start") for size in (0.1, 0.2) for row in drifts(part, size=size)]
        + drifts("slow", true=0.0451, contacts_before=0)
    ),
    "mistakes": dict(
        rows=[dict(kind="none", what="none", status=0, force=0.3), dict(kind="camera", what="focal x 0.9", status=7, force=9)]
    ),
    "mismatched": dict(
        mismatched=[
            dict(case="a", estimator=name, clean=0.5, noise=[0.5, 0.5], believed=[float("inf"), 0.75], screened=[0.5, 0.4])
            for name in ("minimum-energy", "force-balance")
        ],
        screened=dict(missed=0, distrusted=0, mismatched=8),
    ),
    "life": dict(
        weights=[[1.02, 0.01]], lives=[dict(softening=0.2, lives=[[4000, 0.09], None]), dict(softening=0.0, lives=[None])]
    ),
    "degraded-images": dict(
        rows=[dict(way=way, status=status, surface=9.0) for way, status in (("clean", 0), ("mirrored", 0), ("a hair", 7))]
        + [dict(way="a stick", status=8, surface=0.1)]
    ),
    "crash-npz": dict(
        kills=[dict(signal=name, before=at, kept=at + 5, lost=0.25) for name, at in (("SIGTERM", 0), ("SIGKILL", 5))],
        rows=500,
        end=dict(frames=[500, 500], same=500),
    ),
    "fuzz": dict(videos=dict(cases=100, kinds={"refused": 3, "decoded": 97}, broken=[], slowest=0.1, largest_MB=12)),
    "pins": dict(presses=[dict(height=h, file=f, status=0, surface=0.3, force=0.01) for h in (0, 4) for f in PINS]),
    "range": dict(rows=[PRESS | ABOUT | dict(status=status, depth=depth, surface=off) for status, depth, off in THREE]),
    "light-independent": dict(
        bands=[dict(low=low, high=1, frames=4, force=(0.02, 0.3), surface=(0.1, 0.2), found=0.25) for low in (0, 0.02)],
        rows=[dict(sensor=name, true_force=force, contacts=0) for name in "ab" for force in (0.0, 1.0)],
    ),
    "exports": dict(
        rows=[
            dict(number=k, seconds=50 + k, megabytes=3, statuses_equal=True, apart=apart, displacement=2, rounding=0.03)
            for k, apart in ((0, 1e-5), (1, 0.02))
        ]
        + [dict(number=2, error="too large")]
    ),
    "real-bubble": dict(
        surface=[
            dict(estimator=name, frames=2, ok=2, contact=1, rms_contact=0.2, none_contact=0.8, none_before=0.08)
            | dict(deepest=-0.04, away=12.0, rows=[dict(camera_depth=depth) for depth in (5.0, 5.4)])
            for name in ("the sensor's material", "force balance")
        ],
        held=dict(forces=[0.0, 4.5], force=4.5),
        poke=dict(forces=[4.5], rms=0.35),
    ),
    "knocked": dict(
        presses=[
            {
                kind: dict(status=7, still=0, shift=5.0, found=0.9, other=0.001, named=kind == "turned", shape=0.02, force=0.3)
                for kind in ("turned", "shifted")
            }
        ]
    ),
    "weight": dict(
        rows=[
            dict(sensor=name, weight=0, ratios=[1.05], unsure=[], deviation=0.01)
            for group in WEIGHED.values()
            for name in group
        ]
        + [dict(sensor="cap_36_open", weight=1, refused="too uncertain")]
    ),
}
SAID = {
    "drift": ("101 streams", "20,100 frames", "0.0451 px", "9 frames"),
    "mistakes": ("| none | 1 | 0 | 1 |", "| 1 | 1 | 0 |"),
    "mismatched": ("no surface, 2", "0.450"),
    "life": ("1 of 2 lives", "4000 presses", "9 %", "2 %"),
    "degraded-images": (
        "| images | 3 |",
        "off by less than a quarter of the press | 1 |",
        "mirrored or upside down, which cannot be noticed for a symmetric pattern | 1 |",
    ),
    "crash-npz": ("each time | 0.2 s", "500 identical"),
    "fuzz": ("| videos | 100 | 3 | 97 | 0 | 0.1 s | 12 MB |",),
    "pins": ("0 (painted)", "| 4 mm | tips taken for dots | 0.3 / 0.3 | 0.01 / 0.01 | 1 of 1 | 1 |"),
    "range": ("| all | 3 | 0.333 | 0.333 | 0.333 |", "| 0.2 to 0.3 | 1 | 0.00 | 1.00 | 0.00 |"),
    "light-independent": (
        "2 strokes",
        "are 0.02 / 0.30.",
        "1 of 4 contacts is found",
        "2 frames at rest, a contact is reported in none",
    ),
    "exports": ("3 exports, 1 is refused", "(numbers 1)", "1 to 1 %", "50 s of processor", "51 s at most", "3 MB"),
    "real-bubble": ("1 photographs", "up to 5.4 mm deep", "is 0.20 mm", "be 0.80 mm", "within 4 %", "2 of the 2 photographs"),
    "knocked": ("| 5.0 / 5.0 | 5.0 / 5.0 |", "| 1 of 1 | 0 of 1 |", "| 0.020 / 0.020 |", "| 1, 0 | 1, 0 |", "| 1 | 1 |"),
    "weight": ("3 of 4", "1.05 to 1.05", "5.0 %", "all: 20 forces"),
}


@pytest.mark.parametrize("part", RAW)
def test_what_a_benchmark_writes_gives_its_table(part):
    """So that no run of hours ends in an error: a part's record is a summary of what its benchmark writes."""
    table = {"crash-npz": "crash-recovery", "real-bubble": "bubble-surface"}.get(part, part)
    parts, make = TABLES[table]
    made = make(*[SUMMARIES[part](RAW[part])] * len(parts))
    text = made if isinstance(made, str) else pages.markdown(made)
    assert not [each for each in SAID[part] if each not in text], text


def test_the_paragraph_on_the_range_counts_right_presses_with_any_status():
    """Of two shallow presses one is right; the deep one is right and out of range; of all three one is wrong with ok."""
    said = readme_range(SUMMARIES["range"](RAW["range"]))
    assert "50 % are right, and 50 % are right and have status `ok`" in said
    assert "0.3 of the size, these shares are 100 % and 0 %" in said and "one in 3 is wrong" in said
