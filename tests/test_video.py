"""Videos that are cut off or damaged lose no frame silently."""

import struct
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image
from test_batch import HEIGHT, WIDTH, Denting, reconstruct, summary_of

from torchmembrane.errors import MembraneError
from torchmembrane.files.images import to_grey
from torchmembrane.files.video import picture_total, picture_values, video_pictures
from torchmembrane.files.video_end import missing_end
from torchmembrane.live.sources import video_images
from torchmembrane.plot.film import write_film
from torchmembrane.results.read import read_results

SIZE, COUNT = (64, 48), 20
CONTAINERS = {  # ending: codec, options of the container, whether it says how many frames it has
    "mkv": ("h264", {}, False),
    "webm": ("vp9", {}, False),
    "avi": ("mjpeg", {}, True),
    "mp4": ("h264", {"movflags": "faststart"}, True),
    "mov": ("mjpeg", {"movflags": "faststart"}, True),
    "m4v": ("mpeg4", {"movflags": "frag_keyframe+empty_moov"}, False),
    "gif": (None, {}, True),
}
every_container = pytest.mark.parametrize("ending", CONTAINERS)


def video(path: Path, count: int = COUNT, codec: str = "h264", size=SIZE, image=None, format=None, options=None, **metadata):
    """A video of noise, or of `image(k)`; returns its path."""
    rng = np.random.default_rng(0)
    grey = codec == "ffv1"
    with av.open(f"file:{path}", "w", format=format, options=options or {}) as container:
        container.metadata.update(metadata)
        track = container.add_stream(codec, rate=10)
        track.width, track.height = size
        track.pix_fmt = "gray16le" if grey else "yuvj420p" if codec == "mjpeg" else "yuv420p"
        for k in range(count):
            picture = rng.integers(0, 255, (size[1], size[0], 3), np.uint8) if image is None else image(k)
            container.mux(track.encode(av.VideoFrame.from_ndarray(picture, format="gray16le" if grey else "rgb24")))
        container.mux(track.encode())
    return path


def of_container(folder: Path, ending: str) -> Path:
    codec, options, _ = CONTAINERS[ending]
    if codec is not None:
        return video(folder / f"film.{ending}", codec=codec, options=options)
    noise = [Image.fromarray(np.random.default_rng(k).integers(0, 255, SIZE[::-1], np.uint8)) for k in range(COUNT)]
    noise[0].save(folder / "film.gif", save_all=True, append_images=noise[1:], duration=100)
    return folder / "film.gif"


def level(k: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), 40 * (k + 1), np.uint8)


def read(path: Path, size=SIZE) -> tuple[list, str]:
    """What is read of a video, and what ends it."""
    found = []
    try:
        for picture in video_pictures(path, size):
            found.append(picture)
    except MembraneError as error:
        return found, str(error)
    return found, ""


@every_container
def test_a_whole_video_is_read_without_a_remark(tmp_path, ending):
    path = of_container(tmp_path, ending)
    found, said = read(path)
    assert len(found) == COUNT and not said and not any(isinstance(each, MembraneError) for each in found)
    assert picture_total(path) == (COUNT if CONTAINERS[ending][2] else None)


@every_container
@pytest.mark.parametrize("share", [0.5, 0.95])
def test_a_video_that_ends_early_says_how_many_frames_of_how_many_it_has(tmp_path, ending, share):
    path = of_container(tmp_path, ending)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    found, said = read(path)
    unknown = {"gif": "no mark of its end", "m4v": "cut off in one of its fragments"}
    if ending in unknown:  # these say nothing of frames that are not there
        assert said.startswith(f"the file ends early: {len(found)} ") and f"frames are there, {unknown[ending]}" in said
    else:
        lengths = f"{int(share * len(whole))} of at least {len(whole)} bytes"
        assert said.startswith(
            f"the file ends early: {len(found)} of {COUNT} frames are there, {lengths}; expected a whole video"
        )
    assert 1 <= len(found) < COUNT


def test_a_recording_that_was_not_closed_says_so(tmp_path):
    path = video(tmp_path / "film.mp4")
    whole = path.read_bytes()
    at = whole.index(b"moov") - 4
    path.write_bytes(whole[:3000])
    assert f"not readable as a video (Invalid data found when processing input; 3000 of at least {at} bytes)" in read(path)[1]
    path.write_bytes(whole[:at])
    assert "no index (moov), as where a recording was not closed" in read(path)[1]


def test_parts_of_an_avi_begin_at_even_places(tmp_path):
    """A part of 13 bytes, the byte that makes it even, and a part of 12 bytes: whole, and cut off anywhere in the second."""
    first = b"RIFF" + struct.pack("<I", 13) + b"AVI " + bytes(9)
    second = b"RIFF" + struct.pack("<I", 12) + b"AVIX" + bytes(8)
    path, whole = tmp_path / "film.avi", first + bytes(1) + second
    path.write_bytes(whole)
    assert missing_end(path) == ""
    for lost in (1, 12):
        path.write_bytes(whole[:-lost])
        assert missing_end(path) == f"{42 - lost} of at least 42 bytes"


def test_an_early_end_is_a_failed_frame_and_the_batch_goes_on(tmp_path):
    cut = video(tmp_path / "cut.avi", 4, "mjpeg", (WIDTH, HEIGHT), level)
    content = cut.read_bytes()
    cut.write_bytes(content[: content.rindex(b"00dc", 0, content.rindex(b"idx1"))])
    whole = video(tmp_path / "whole.avi", 2, "mjpeg", (WIDTH, HEIGHT), level)
    outcome, lines, _ = reconstruct([cut, whole], tmp_path / "out")
    assert outcome[0] == 5 and outcome.failed == 1
    assert len(lines) == 1 and f"{cut}, cut_000003: the file ends early: 3 of 4 frames are there" in lines[0]
    assert "3 of 4 frames" in summary_of(tmp_path / "out")["cut_000003"]["status_text"]
    cut.write_bytes(content)
    outcome, lines, _ = reconstruct([cut, whole], tmp_path / "out")
    assert outcome[0] == 4 and outcome.failed == 0 and lines[0].endswith("changed, done again")


def test_a_damaged_picture_of_a_video_is_a_failed_frame_of_its_own(tmp_path):
    path = video(tmp_path / "film.avi", 5, "mjpeg", (WIDTH, HEIGHT), level)
    content = bytearray(path.read_bytes())
    at = [k for k in range(content.index(b"movi"), len(content)) if content[k : k + 4] == b"00dc"][2]
    size = struct.unpack("<I", content[at + 4 : at + 8])[0]
    content[at + 8 : at + 8 + size] = bytes(size)
    path.write_bytes(content)
    outcome, lines, _ = reconstruct([path], tmp_path / "out")
    assert outcome[0] == 4 and outcome.failed == 1 and "film_000002: a damaged picture" in lines[0]
    pressures = [255 * float(frame["pressure"]) for frame in read_results(tmp_path / "out")]
    assert pressures == pytest.approx([40, 80, 160, 200], abs=4)


def test_pictures_that_are_coded_by_a_damaged_one_are_damaged(tmp_path):
    still = np.random.default_rng(0).integers(0, 200, (SIZE[1], SIZE[0], 3), np.uint8)
    path = video(tmp_path / "film.avi", 9, "mpeg4", image=lambda k: still + np.uint8(k))
    content = bytearray(path.read_bytes())
    at = content.index(b"00dc", content.index(b"movi")) + 300
    content[at : at + 900] = bytes(900)
    path.write_bytes(content)
    found, said = read(path)
    assert len(found) == 9 and not said and all(isinstance(each, MembraneError) for each in found)


NAMES = ["2024-01-05T12:30:05.mp4", "./12:30.mp4", "sub:folder/a.mp4", r"C:\films\a.mp4", "C:a.mp4", "http:a.mp4", "-a:b.mp4"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("absolute", [False, True])
def test_a_colon_in_a_name_is_no_protocol(tmp_path, monkeypatch, name, absolute):
    monkeypatch.chdir(tmp_path)
    Path("sub:folder").mkdir()
    path = tmp_path / name if absolute else Path(name)
    write_film(path, map(level, range(3)), 10)
    assert [entry.suffix for entry in path.parent.iterdir() if entry.is_file()] == [".mp4"]  # and no part of one
    assert reconstruct([str(path) if absolute else name], tmp_path / "out")[0][0] == 3
    assert len(list(video_images(path, (WIDTH, HEIGHT), None))) == 3


def test_damaged_text_in_a_video_is_no_matter(tmp_path):
    path = video(tmp_path / "film.avi", 3, "mjpeg", title="a title of a film")
    path.write_bytes(path.read_bytes().replace(b"a title", b"\xff\xfe\xc3(\x80\xe2("))
    found, said = read(path)
    assert len(found) == 3 and not said and picture_total(path) == 3
    assert len(list(video_images(path, SIZE, None))) == 3


def sound(path: Path, codec: str, format: str) -> bytes:
    with av.open(str(path), "w", format=format) as container:
        track = container.add_stream(codec, rate=44100)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 44100), np.int16), "s16", "mono")
        frame.sample_rate = 44100
        resampler = av.AudioResampler(track.codec_context.format, track.codec_context.layout, 44100, track.frame_size or 1152)
        for part in [*resampler.resample(frame), *resampler.resample(None)]:
            container.mux(track.encode(part))
        container.mux(track.encode())
    return path.read_bytes()


def box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", 8 + len(content)) + kind + content


def with_cover(folder: Path, ending: str) -> Path:
    """A sound file with an embedded picture of the sensor's size."""
    path = folder / f"song.{ending}"
    Image.fromarray(level(1)).save(folder / "cover.jpg")
    cover, mime = (folder / "cover.jpg").read_bytes(), b"image/jpeg"
    if ending == "mp3":
        content = sound(path, "mp3", "mp3")
        body = b"\0" + mime + b"\0\x03\0" + cover
        tag = b"APIC" + struct.pack(">I", len(body)) + b"\0\0" + body
        size = bytes((len(tag) >> shift) & 127 for shift in (21, 14, 7, 0))
        path.write_bytes(b"ID3\x03\0\0" + size + tag + content)
    elif ending == "flac":
        content = sound(path, "flac", "flac")
        kind = struct.pack(">II", 3, len(mime)) + mime + struct.pack(">5I", 0, WIDTH, HEIGHT, 24, 0)
        block = kind + struct.pack(">I", len(cover)) + cover
        path.write_bytes(content[:42] + b"\x06" + struct.pack(">I", len(block))[1:] + block + content[42:])
    else:
        content = sound(path, "aac", "ipod")
        data = box(b"data", struct.pack(">II", 13, 0) + cover)
        handler = box(b"hdlr", bytes(8) + b"mdirappl" + bytes(9))
        udta = box(b"udta", box(b"meta", bytes(4) + handler + box(b"ilst", box(b"covr", data))))
        at = content.index(b"moov") - 4
        size = struct.unpack(">I", content[at : at + 4])[0]
        moov = content[at + 8 : at + size]
        moov = moov[: moov.index(b"udta") - 4] if b"udta" in moov else moov
        path.write_bytes(content[:at] + box(b"moov", moov + udta) + content[at + size :])
    return path


@pytest.mark.parametrize("ending", ["mp3", "flac", "m4a"])
def test_a_song_with_a_cover_is_no_video(tmp_path, ending):
    path = with_cover(tmp_path, ending)
    with av.open(str(path)) as container:
        assert container.streams.video  # which is the cover
    outcome, lines, _ = reconstruct([path], tmp_path / "out", video=True)
    assert outcome[0] == 0 and "no video: the file holds sound and a cover picture; expected a video" in lines[0]
    with pytest.raises(MembraneError, match=f"--video .*song.{ending}: no video"):
        list(video_images(path, (WIDTH, HEIGHT), None))


def test_sound_alone_is_no_video(tmp_path):
    sound(tmp_path / "a.mp4", "aac", "mp4")
    assert "no video: the file holds sound; expected a video" in read(tmp_path / "a.mp4")[1]


def test_grey_of_16_bits_is_read_with_the_bits_of_the_camera(tmp_path):
    values = np.random.default_rng(0).integers(0, 4096, SIZE[::-1], np.uint16)
    path = video(tmp_path / "deep.mkv", 2, "ffv1", image=lambda k: values)
    for bits, white in ((12, 4095), (None, 65535)):
        for picture in read(path)[0]:
            assert np.abs(to_grey(picture_values(picture, bits)) - values / white).max() < 1e-6
    with pytest.raises(MembraneError, match="expected at most 1023, as bits = 10"):
        picture_values(read(path)[0][0], 10)


def test_a_video_of_another_size_is_refused_once(tmp_path):
    path = video(tmp_path / "film.mp4", 4)
    outcome, lines, _ = reconstruct([path], tmp_path / "out", reconstructor=Denting())
    assert outcome.failed == len(lines) == 1 and "images of 64 x 48 px; expected the sensor's 16 x 12" in lines[0]


@pytest.mark.parametrize("name, begun", [("20260927T113829", 1790509109.0), ("press", 0.0)])
def test_the_time_of_a_cut_video_s_frames_counts_from_its_first(tmp_path, name, begun):
    """A part of a recording may keep the times of the whole: its pictures are here from 60 s on."""
    path = tmp_path / f"{name}.mkv"
    with av.open(str(path), "w") as container:
        track = container.add_stream("ffv1", rate=10)
        track.width, track.height, track.pix_fmt = WIDTH, HEIGHT, "gray"
        for k in range(3):
            picture = av.VideoFrame.from_ndarray(level(k)[..., 0], format="gray")
            picture.pts = 600 + k
            container.mux(track.encode(picture))
        container.mux(track.encode())
    reconstruct([path], tmp_path / "out", reconstructor=Denting())
    times = [float(row["time"]) for row in summary_of(tmp_path / "out").values()]
    np.testing.assert_allclose(np.array(times) - begun, np.arange(3) / 10, atol=2e-3)


def test_a_video_without_times_is_played_at_its_own_pace(tmp_path):
    """A bare H.264 stream: its pictures have no times, and its header says 25 Hz."""
    path = video(tmp_path / "film.h264", 5, image=level, size=(WIDTH, HEIGHT), format="h264")
    due = [each.due for each in video_images(path, (WIDTH, HEIGHT), None)]
    np.testing.assert_allclose(due, np.arange(5) / 25)
