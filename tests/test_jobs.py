"""Killed, doubled or divided jobs lose no frame and repeat none."""

import csv
import os
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import quickly_saving
import torch
from PIL import Image
from test_batch import CONTRACT, HEIGHT, NPZ, PARQUET, WIDTH, Denting, grey_image, reconstruct, summary_of

from torchmembrane.cli.main import main
from torchmembrane.errors import MembraneError
from torchmembrane.files.folder_lock import WHOLE, FolderLock, Shard
from torchmembrane.files.provenance import SourceFile
from torchmembrane.jobs import workers
from torchmembrane.jobs.inputs import find_inputs
from torchmembrane.jobs.workers import (
    FRAMES_EACH,
    LARGEST_BATCH,
    MEMORY_SHARE,
    batch_for,
    frame_bytes,
    memory_here,
    workers_for,
)
from torchmembrane.results import frame_table
from torchmembrane.results.npz import save_frame
from torchmembrane.results.read import read_results
from torchmembrane.results.reconstruction import Reconstruction

both = pytest.mark.parametrize("settings", [NPZ, PARQUET], ids=["npz", "parquet"])


@pytest.fixture
def images(tmp_path) -> list[Path]:
    (tmp_path / "images").mkdir()
    return [grey_image(tmp_path / "images" / f"i{k}.png", 40 + 30 * k) for k in range(5)]


def rows_in(out: Path) -> list[str]:
    return sorted(name for part in (out / "frames").glob("*.parquet") for name in pq.read_table(part)["name"].to_pylist())


def test_parquet_rows_are_on_the_disk_while_work_goes_on(images, tmp_path, monkeypatch):
    monkeypatch.setattr(frame_table, "SAVE_SECONDS", 0.0)
    seen = []

    class Watching(Denting):
        def __call__(self, batch):
            seen.append(rows_in(tmp_path / "out"))
            return super().__call__(batch)

    reconstruct(images, tmp_path / "out", PARQUET, Watching())
    assert [len(names) for names in seen] == [0, 2, 4]
    assert rows_in(tmp_path / "out") == [path.stem for path in images]
    assert len(list((tmp_path / "out" / "frames").iterdir())) == 1


def test_small_parts_become_large_ones_as_they_gather(images, tmp_path, monkeypatch):
    monkeypatch.setattr(frame_table, "SAVE_SECONDS", 0.0)
    monkeypatch.setattr(frame_table, "PART_ROWS", 4)
    paths = [grey_image(images[0].parent / f"m{k:02d}.png", 99) for k in range(19)]
    parts = []

    class Watching(Denting):
        def __call__(self, batch):
            parts.append(len(list((tmp_path / "out" / "frames").glob("*.parquet"))))
            return super().__call__(batch)

    reconstruct(paths, tmp_path / "out", PARQUET, Watching())
    assert parts == [0, 1, 1, 2, 2, 3, 3, 4, 4, 5]
    sizes = [pq.read_metadata(part).num_rows for part in sorted((tmp_path / "out" / "frames").glob("*.parquet"))]
    assert sizes == [4, 4, 4, 4, 3] and rows_in(tmp_path / "out") == [path.stem for path in paths]


def test_rows_that_an_interrupted_merge_left_twice_are_taken_out(images, tmp_path):
    reconstruct(images, tmp_path / "out", PARQUET)
    part = tmp_path / "out" / "frames" / "part-00000.parquet"
    table = pq.read_table(part)
    pq.write_table(table.slice(3), part.with_name("part-00001.parquet"))
    assert len(read_results(tmp_path / "out").batch().status) == 5
    assert reconstruct(images, tmp_path / "out", PARQUET)[0] == (0, 0, 0, 0, 0, 0, 5)
    assert rows_in(tmp_path / "out") == [path.stem for path in images]


@both
def test_a_new_image_under_an_old_name_is_done_again(images, tmp_path, settings):
    reconstruct(images, tmp_path / "out", settings)
    grey_image(images[1], 200)
    os.utime(images[2], ns=(1, 1))
    outcome, lines, _ = reconstruct(images, tmp_path / "out", settings)
    assert outcome == (1, 0, 0, 0, 0, 0, 4) and lines == [f"{images[1]}: changed, done again"]
    assert float(read_results(tmp_path / "out")["i1"]["pressure"]) == pytest.approx(200 / 255, abs=1e-5)
    assert summary_of(tmp_path / "out")["i1"]["content_hash"] == SourceFile.from_files(images[1]).content_hash
    assert reconstruct(images, tmp_path / "out", settings)[0] == (0, 0, 0, 0, 0, 0, 5)


def stack(path: Path, *levels: int) -> Path:
    pages = [Image.new("L", (WIDTH, HEIGHT), level) for level in levels]
    pages[0].save(path, save_all=True, append_images=pages[1:])
    return path


@both
@pytest.mark.parametrize("pages, left", [((200, 210), ["run_000000", "run_000001"]), ((200,), ["run"])])
def test_frames_that_a_changed_file_no_longer_contains_are_removed(pages, left, tmp_path, settings):
    reconstruct([stack(tmp_path / "run.tif", 40, 50, 60, 70)], tmp_path / "out", settings)
    other = grey_image(tmp_path / "run_000003.png", 90)
    reconstruct([other], tmp_path / "out", settings)  # of another file: kept
    outcome, lines, _ = reconstruct([stack(tmp_path / "run.tif", *pages)], tmp_path / "out", settings)
    names = [*left, "run_000003"]
    assert outcome.reconstructed == len(pages) and sorted(read_results(tmp_path / "out").names) == names
    assert sorted(summary_of(tmp_path / "out")) == names and "removed, as the changed file does not contain" in lines[-1]
    found = [float(read_results(tmp_path / "out")[name]["pressure"]) for name in names]
    np.testing.assert_allclose(found, np.array([*pages, 90]) / 255, atol=1e-5)


def test_frames_that_a_changed_file_may_still_contain_are_kept(tmp_path):
    path = stack(tmp_path / "run.tif", 40, 50, 60, 70)
    reconstruct([path], tmp_path / "out")
    path.write_bytes(path.read_bytes()[:-100])
    outcome, lines, _ = reconstruct([path], tmp_path / "out")
    assert outcome.failed and read_results(tmp_path / "out").names[-1] > "run_000000"
    assert not any("removed" in line for line in lines)


class Gauged(Denting):
    """The reading of a frame is its pressure."""

    def __call__(self, images, pressure):
        return super().__call__(images)._replace(pressure=pressure)


@both
def test_a_frame_with_another_gauge_reading_is_done_again(images, tmp_path, settings):
    readings = {f"i{k}": 0.1 + k for k in range(4)}
    settings = settings._replace(pressure="gauge.csv")
    reconstruct(images[:4], tmp_path / "out", settings, Gauged(), pressure=readings)
    same = reconstruct(images, tmp_path / "out", settings, Gauged(), pressure=readings)
    assert same[0] == (1, 0, 0, 0, 0, 0, 4) and same[1] == []
    outcome, lines, _ = reconstruct(images, tmp_path / "out", settings, Gauged(), pressure=readings | {"i1": 7.0, "i4": 9.0})
    assert outcome == (2, 0, 0, 0, 0, 0, 3) and lines == ["i1 and 1 more: the gauge reading has changed, done again"]
    results = read_results(tmp_path / "out")
    assert [float(results[f"i{k}"]["pressure"]) for k in range(5)] == pytest.approx([0.1, 7.0, 2.1, 3.1, 9.0])


def test_a_name_is_that_of_a_picture_only_as_it_is_written(tmp_path):
    path = stack(tmp_path / "run.tif", 40, 50)
    inputs = find_inputs([path])
    assert inputs.video_of("run_000001") == path and inputs.video_of("run_1000001") == path
    assert not any(
        map(inputs.video_of, ("run_1", "run_0000001", "run_\u0661\u0661\u0661\u0661\u0661\u0661", "run_", "other_000001"))
    )
    assert len(find_inputs([path, grey_image(tmp_path / "run_1.png", 90)]).images) == 1


def test_results_without_hashes_are_kept_and_that_is_said_once(images, tmp_path):
    made = reconstruct(images, tmp_path / "out")[2]
    for path in images:
        np.savez(tmp_path / "out" / f"{path.stem}.npz", **made(made.read(path)).frame(0))
    outcome, lines, _ = reconstruct(images, tmp_path / "out")
    assert outcome == (0, 0, 0, 0, 0, 0, 5) and len(lines) == 1 and "5 results do not say" in lines[0]
    assert summary_of(tmp_path / "out")["i2"]["file"] == str(images[2])


def test_a_dataset_of_before_is_resumed_in_the_form_of_now(images, tmp_path):
    made = reconstruct(images, tmp_path / "out", PARQUET)[2]
    part = tmp_path / "out" / "frames" / "part-00000.parquet"
    table = pq.read_table(part)
    columns = {"name": table["name"]}
    for key in Reconstruction._fields:
        values = torch.cat([getattr(made(made.read(path)), key) for path in images]).numpy()
        values = values.astype(np.int32 if key == "status" else np.float32)
        flat = pa.array(values.ravel())
        size = values[0].size
        columns[key] = pa.FixedSizeListArray.from_arrays(flat, size) if values.ndim > 1 else flat
    pq.write_table(pa.table(columns).replace_schema_metadata(table.schema.metadata), part)
    before = read_results(tmp_path / "out").batch()
    outcome, lines, _ = reconstruct([*images, grey_image(tmp_path / "new.png", 77)], tmp_path / "out", PARQUET)
    assert outcome == (1, 0, 0, 0, 0, 0, 5) and "5 results do not say" in lines[0]
    assert pq.read_table(part.parent).column_names == table.column_names
    after = read_results(tmp_path / "out").batch()
    assert torch.equal(after.vertices[:5], before.vertices) and len(after.status) == 6


def ends_of_values(path: Path) -> list[int]:
    """The place in a file of results of each array's last byte."""
    if path.suffix == ".parquet":
        group = pq.read_metadata(path).row_group(0)
        columns = [group.column(k) for k in range(group.num_columns)]
        return [column.data_page_offset + column.total_compressed_size - 1 for column in columns]
    with zipfile.ZipFile(path) as archive:
        return [start - 1 for start in [*sorted(member.header_offset for member in archive.infolist())[1:], archive.start_dir]]


@pytest.mark.parametrize("others", [6, pytest.param(25, marks=pytest.mark.full)])
@both
def test_a_damaged_result_is_done_again_and_that_is_said_once(images, tmp_path, settings, others):
    """Wherever a bit flips the answers stay what they were; where it flips in an array's values, that is noticed."""
    reconstruct(images, tmp_path / "out", settings)
    damaged = tmp_path / "out" / ("i3.npz" if settings is NPZ else "frames/part-00000.parquet")
    before, whole = read_results(tmp_path / "out").batch(), damaged.read_bytes()
    in_values = ends_of_values(damaged)
    assert len(in_values) >= len(CONTRACT)
    for place in (*in_values, *np.linspace(0.02, 0.98, others) * len(whole)):
        content = bytearray(whole)
        content[int(place)] ^= 0x10
        damaged.write_bytes(content)
        outcome, lines, _ = reconstruct(images, tmp_path / "out", settings)
        assert all(torch.equal(a, b) for a, b in zip(read_results(tmp_path / "out").batch(), before, strict=True)), place
        assert lines in ([], [f"{damaged}: damaged, done again"]) and bool(lines) == bool(outcome.reconstructed)
        assert lines or place not in in_values
        damaged.write_bytes(whole)
    assert reconstruct(images, tmp_path / "out", settings)[:2] == ((0, 0, 0, 0, 0, 0, 5), [])


def test_a_damaged_summary_is_made_anew_from_the_frames(images, tmp_path):
    images[4].write_bytes(b"broken")
    reconstruct(images, tmp_path / "out")
    path = tmp_path / "out" / "summary.csv"
    before, content = path.read_text(), bytearray(path.read_bytes())
    for spoiled in (content[:90] + b"\xff\x00" + content[90:], content[:300], b""):
        path.write_bytes(spoiled)
        assert reconstruct(images, tmp_path / "out")[0] == (0, 0, 0, 0, 0, 1, 4)
        assert path.read_text() == before


def test_the_summary_of_a_killed_job_keeps_its_seconds(images, tmp_path):
    reconstruct(images, tmp_path / "out")
    (tmp_path / "out" / "summary.csv").unlink()
    reconstruct(images, tmp_path / "out")
    assert all(float(row["seconds"]) > 0 for row in summary_of(tmp_path / "out").values())


@both
def test_bad_names_do_not_stop_the_run(images, tmp_path, settings):
    folder = images[0].parent
    long = grey_image(folder / f"{'n' * 251}.png", 90)
    strange = folder / os.fsdecode(b"caf\xe9.png")
    images[1].rename(strange)
    too_long = folder / os.fsdecode(b"\xff" * 100 + b".png")
    images[2].rename(too_long)
    os.mkfifo(folder / "pipe.png")
    paths = [images[0], long, strange, too_long, folder / "pipe.png"]
    outcome, lines, _ = reconstruct(paths, tmp_path / "out", settings)
    assert outcome == (3, 0, 0, 0, 0, 2, 0)
    assert "400 bytes" in lines[0] and "regular file" in lines[1]
    assert read_results(tmp_path / "out").names == ["caf\\xe9", "i0", "n" * 251]
    assert reconstruct(paths, tmp_path / "out", settings)[0] == (0, 0, 0, 0, 0, 2, 3)


def test_a_name_that_a_spreadsheet_takes_for_a_formula_is_quoted(images, tmp_path):
    paths = [grey_image(images[0].parent / f"{name}.png", 99) for name in ("=1+1", "+a", "-b", "@c", "'=d")]
    broken = images[0].parent / "=broken.png"
    broken.write_bytes(b"broken")
    for _ in range(2):
        reconstruct([*paths, broken], tmp_path / "out")
    with open(tmp_path / "out" / "summary.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert sorted(row["name"] for row in rows) == sorted(["'=1+1", "'+a", "'-b", "'@c", "''=d", "'=broken"])
    assert all(float(row["deepest"]) < 0 for row in rows if row["status"] == "0")


@pytest.mark.parametrize("text", ["=cmd|' /C calc'!A0", "+1", "-1", "@SUM(1)", "\t=1", " =1", "＝1", "'=1"])
def test_what_a_result_says_of_its_file_is_no_formula_of_the_summary(text, images, tmp_path):
    reconstruct(images, tmp_path / "out")
    result = tmp_path / "out" / "i1.npz"
    with np.load(result) as file:
        arrays = dict(file)
    np.savez(result, **arrays | {"content_hash": text, "path": text})
    for _ in range(2):
        reconstruct([images[0]], tmp_path / "out")
        row = summary_of(tmp_path / "out")["i1"]
        assert row["content_hash"] == row["file"] == f"'{text}"


@pytest.mark.parametrize("column", ["residual_px", "force_z", "seconds", "status"])
def test_a_row_of_another_shard_without_a_number_where_one_belongs_is_left_out(column, images, tmp_path):
    for shard in (Shard(1, 2), Shard(2, 2)):
        reconstruct(images, tmp_path / "out", shard=shard)
    rows = list(summary_of(tmp_path / "out").values())
    other = next(row for row in rows if Shard(2, 2).holds(row["name"]))
    other[column] = "=1+1"
    with open(tmp_path / "out" / "summary.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(other))
        writer.writeheader()
        writer.writerows(rows)
    reconstruct(images, tmp_path / "out", shard=Shard(1, 2))
    assert set(summary_of(tmp_path / "out")) == {row["name"] for row in rows} - {other["name"]}


def test_a_locked_folder_is_refused_until_the_other_job_ends(images, tmp_path):
    with FolderLock(tmp_path / "out", WHOLE):
        for shard in (WHOLE, Shard(2, 2)):
            with pytest.raises(MembraneError, match="another job is writing there .all frames"):
                reconstruct(images, tmp_path / "out", shard=shard)
    with FolderLock(tmp_path / "out", Shard(1, 2)):
        for shard in (WHOLE, Shard(1, 2), Shard(2, 3)):
            with pytest.raises(MembraneError, match="shard 1/2"):
                reconstruct(images, tmp_path / "out", shard=shard)
        reconstruct(images, tmp_path / "out", shard=Shard(2, 2))
    reconstruct(images, tmp_path / "out")
    assert not [path for path in (tmp_path / "out").iterdir() if path.name.startswith(".")]


def test_a_lock_ends_with_a_killed_process(tmp_path):
    script = (
        "import sys, time; from pathlib import Path; from torchmembrane.files.folder_lock import FolderLock, WHOLE\n"
        "with FolderLock(Path(sys.argv[1]), WHOLE): print('locked', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", script, tmp_path / "out"], stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"locked\n"
        with pytest.raises(MembraneError), FolderLock(tmp_path / "out", WHOLE):
            pass
        process.kill()
    with FolderLock(tmp_path / "out", WHOLE) as lock:
        assert lock.alone


@both
def test_shards_are_disjoint_and_together_everything(images, tmp_path, settings, monkeypatch):
    monkeypatch.setattr(frame_table, "SAVE_SECONDS", 0.0)
    paths = [grey_image(images[0].parent / f"s{k:02d}.png", 40 + k) for k in range(20)]
    paths[3].write_bytes(b"broken")
    outcomes = []

    class Dividing(Denting):
        """The first shard's job, in the midst of which the others run."""

        def __call__(self, batch):
            if not outcomes:
                for number in (2, 3):
                    outcomes.append(reconstruct(paths, tmp_path / "out", settings, shard=Shard(number, 3))[0])
            return super().__call__(batch)

    outcomes.append(reconstruct(paths, tmp_path / "out", settings, Dividing(), shard=Shard(1, 3))[0])
    assert sum(outcome.reconstructed for outcome in outcomes) == 19 and sum(outcome.failed for outcome in outcomes) == 1
    good = [path.stem for path in paths if path != paths[3]]
    assert read_results(tmp_path / "out").names == good
    assert sorted(summary_of(tmp_path / "out")) == [path.stem for path in paths]
    assert reconstruct(paths, tmp_path / "out", settings)[0] == (0, 0, 0, 0, 0, 1, 19)
    if settings is PARQUET:
        assert rows_in(tmp_path / "out") == good


@pytest.mark.usefixtures("quick_processes")
@pytest.mark.parametrize("settings", [pytest.param(NPZ, id="npz", marks=pytest.mark.full), pytest.param(PARQUET, id="parquet")])
def test_worker_processes_give_what_one_process_gives(small_sensor, small_images, tmp_path, monkeypatch, settings):
    from torchmembrane import Reconstructor
    from torchmembrane.jobs.local import reconstruct_files
    from torchmembrane.results.store import Settings

    monkeypatch.setattr(workers, "AHEAD", 1)
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"broken")
    reconstructor = Reconstructor.from_file(small_sensor / "sensor.toml")
    found, lines = [], []
    for count in (1, 2):
        out, made = tmp_path / f"out{count}", Settings.from_reconstructor(reconstructor, settings.format)
        options = {"batch": 1, "workers": count, "report": lines.append, "figures": count == 2}
        counts = reconstruct_files(reconstructor, find_inputs([*small_images, broken]), out, made, **options)
        assert (counts.reconstructed, counts.failed) == (3, 1)
        found.append(read_results(out))
    assert found[0].names == found[1].names and lines[0] == lines[1]
    for a, b in zip(*found, strict=True):
        assert all(np.array_equal(a[key], b[key], equal_nan=True) for key in a)
    assert len(list((tmp_path / "out2").glob("press*.png"))) == 3


def wait_for(condition, seconds=120):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


FRAMES = 40


@pytest.mark.parametrize(
    "end, format, workers",
    [
        pytest.param(signal.SIGTERM, "npz", "1", marks=pytest.mark.full),
        (signal.SIGTERM, "parquet", "2"),
        (signal.SIGKILL, "parquet", "1"),
    ],
)
def test_a_killed_command_keeps_what_is_done(
    small_sensor, small_images, tmp_path, capsys, quick_processes, end, format, workers
):
    (tmp_path / "images").mkdir()
    for k in range(FRAMES):
        (tmp_path / "images" / f"k{k:03d}.png").hardlink_to(small_images[k % 3])
    out = tmp_path / "out"
    options = ["--out", str(out), "--format", format, "--batch", "1", "--workers"]
    command = ["reconstruct", str(small_sensor / "sensor.toml"), str(tmp_path / "images"), *options]

    def done() -> int:
        return len(rows_in(out)) if format == "parquet" else len(list(out.glob("k*.npz")))

    process = quick_processes.Process(target=quickly_saving.command, args=([*command, workers], tmp_path / "said"))
    process.start()
    wait_for(lambda: done() > 0 or not process.is_alive())
    os.kill(process.pid, end)
    process.join()
    assert process.exitcode == (143 if end == signal.SIGTERM else -signal.SIGKILL), (tmp_path / "said").read_text()
    kept = done()
    assert 0 < kept < FRAMES
    main([*command, "1"])
    assert f"{FRAMES - kept} reconstructed, 0 failed, {kept} finished before" in capsys.readouterr().out
    assert read_results(out).names == list(summary_of(out)) == [f"k{k:03d}" for k in range(FRAMES)]
    assert not [path for path in out.rglob(".*")]


def test_frames_are_the_same_in_any_batch_within_the_stated_bound(small_sensor, small_images):
    from torchmembrane import Reconstructor

    reconstructor = Reconstructor.from_file(small_sensor / "sensor.toml")
    images = reconstructor.read(*small_images)
    together = reconstructor(images.repeat(6, 1, 1, 1))
    for k in range(3):
        alone = reconstructor(images[k : k + 1])
        assert (alone.vertices[0] - together.vertices[k]).abs().max() < 1e-3
        assert (alone.force[0] - together.force[k]).norm() < 1e-3 * together.force[k].norm().clamp_min(0.1)
        assert (alone.residual[0] - together.residual[k]).abs() < 1e-3
        assert torch.equal(alone.confidence[0], together.confidence[k])


def test_progress_says_rate_failed_and_unconverged(images, tmp_path, capfd):
    images[0].write_bytes(b"broken")
    grey_image(images[1], 10)  # of these Denting does not converge
    reconstruct(images, tmp_path / "out")
    last = capfd.readouterr().err.split("\r")[-1]
    assert "5/5" in last and "frame/s" in last and "failed=1, not converged=1" in last


@pytest.mark.parametrize("workers, vertices, width", [(1, 289, 640), (2, 1089, 1920), (8, 4225, 4000), (1, 4225, 8000)])
def test_batches_take_their_share_of_the_memory_at_most(monkeypatch, workers, vertices, width):
    size, memory = (width, 3 * width // 4), 8 * 2**30
    monkeypatch.setattr("torchmembrane.jobs.workers.memory_here", lambda: memory)
    batch = batch_for(size, vertices, workers, "cpu")
    taken = workers * frame_bytes(size, vertices)
    assert batch == 1 or batch * taken <= MEMORY_SHARE * memory
    assert batch == LARGEST_BATCH or (batch + 1) * taken > MEMORY_SHARE * memory


def test_worker_processes_are_as_many_as_are_worth_their_start_and_no_more_than_cores(monkeypatch):
    monkeypatch.setattr("torchmembrane.jobs.workers.cores", lambda: 4)
    frames = [0, 1, 2 * FRAMES_EACH - 1, 2 * FRAMES_EACH, 3 * FRAMES_EACH, 100 * FRAMES_EACH]
    assert [workers_for(count, "cpu") for count in frames] == [1, 1, 1, 2, 3, 4]
    assert workers_for(100 * FRAMES_EACH, "cuda") == 1


def test_the_memory_is_the_container_s_where_that_has_less(tmp_path, monkeypatch):
    limit = tmp_path / "memory.max"
    monkeypatch.setattr("torchmembrane.jobs.workers.CONTAINER", limit)
    machine = memory_here()
    for text, expected in ((str(2**20), 2**20), (str(2**60), machine), ("max\n", machine)):
        limit.write_text(text)
        assert memory_here() == expected
    assert machine > 2**20


PEAK = """
import ctypes, re, sys, torch
from pathlib import Path
import torchmembrane as tm
torch.set_num_threads(1)
reconstructor = tm.Reconstructor.from_file(sys.argv[1])
frames = int(sys.argv[2])
images = reconstructor.read(*sys.argv[3:]).repeat(6, 1, 1, 1)[:frames]
ctypes.CDLL(None).malloc_trim(0)
Path("/proc/self/clear_refs").write_text("5")
held = lambda: int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) * 1024
before = held()
with torch.no_grad():
    reconstructor(images)
print(held() - before, len(reconstructor.vertex_pixels), *reconstructor.image_size)
"""


@pytest.mark.parametrize("frames", [4, pytest.param(16, marks=pytest.mark.full)])
def test_a_batch_takes_no_more_memory_than_it_is_taken_for(frames):
    examples = Path(__file__).parents[1] / "examples"
    presses = [str(examples / f"{name}.png") for name in ("press_on_axis", "two_contacts", "flat_plate")]
    command = [sys.executable, "-c", PEAK, str(examples / "sensor.toml"), str(frames), *presses]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    peak, vertices, width, height = map(int, done.stdout.split())
    assert 10 * 2**20 < peak <= frames * frame_bytes((width, height), vertices)


@both
def test_view_draws_a_frame_of_a_folder_or_a_part(small_sensor, small_images, tmp_path, monkeypatch, capsys, settings):
    monkeypatch.setattr("torchmembrane.cli.view._has_display", lambda: False)
    out, given = tmp_path / "out", [str(small_sensor / "sensor.toml"), *map(str, small_images[:2])]
    assert main(["reconstruct", *given, "--out", str(out), "--format", settings.format]) == 0
    whole = [out] if settings is NPZ else [out, out / "frames" / "part-00000.parquet"]
    for number, path in enumerate(whole):
        drawn = tmp_path / f"{number}.png"
        assert main(["view", str(path), "--frame", "press1", "--out", str(drawn)]) == 0 and drawn.exists()
        assert main(["view", str(path)]) == 0 and (out / "press0_view.png").exists()
        (out / "press0_view.png").unlink()
        assert main(["view", str(path), "--frame", "press9"]) == 2
        assert "no frame 'press9'" in capsys.readouterr().err
    (tmp_path / "bad.parquet").write_bytes(b"PAR1")
    assert main(["view", str(tmp_path / "bad.parquet")]) == 2 and "not usable as a part" in capsys.readouterr().err


def test_an_interruption_amid_a_result_is_one(tmp_path, monkeypatch):
    def close(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("zipfile._ZipWriteFile.close", close)
    with pytest.raises(KeyboardInterrupt):
        save_frame(tmp_path / "frame.npz", {"force": np.zeros(3)})
    assert not list(tmp_path.iterdir())
