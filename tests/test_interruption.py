"""SIGINT and SIGTERM end every command soon and cleanly."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from torchmembrane.cli import check
from torchmembrane.cli.main import main
from torchmembrane.interruption import Interrupted, ended_by_signals, starting_processes

ROOT = Path(__file__).parents[1]
SIGINT, SIGTERM = (pytest.param(number, id=number.name) for number in (signal.SIGINT, signal.SIGTERM))
BOTH = pytest.mark.parametrize("number", [SIGINT, SIGTERM])
FIRST = pytest.mark.parametrize("number", [SIGINT, pytest.param(signal.SIGTERM, id="SIGTERM", marks=pytest.mark.full)])
LAST = pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, id="SIGINT", marks=pytest.mark.full), SIGTERM])
SLOW = 3.0
"""Seconds for what is said to take two, on a machine with much else to do."""


def members(group: int) -> list[str]:
    """The processes of a group, but for those that have ended and the one that watches over shared memory."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields, line = (folder / "stat").read_text().rpartition(")")[2].split(), (folder / "cmdline").read_text()
        except OSError:
            continue
        if int(fields[2]) == group and fields[0] != "Z" and "resource_tracker" not in line:
            found.append(line.replace("\0", " "))
    return found


class Ended:
    """What became of a process that got a signal."""

    def __init__(self, command, number, ready="ready", delay=0.0, group=False, again=None, **environment):
        pipes = dict(stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=ROOT)
        variables = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"} | environment
        with subprocess.Popen([sys.executable, *map(str, command)], start_new_session=True, env=variables, **pipes) as process:
            self.said = b""
            while ready.encode() not in self.said and (came := os.read(process.stdout.fileno(), 4096)):
                self.said += came
            time.sleep(delay)
            begun = time.monotonic()
            (os.killpg if group else os.kill)(process.pid, number)
            if again is not None:
                time.sleep(again)
                os.kill(process.pid, number)
            process.wait(60)
            self.seconds = time.monotonic() - begun
            time.sleep(0.2)
            self.left = members(process.pid)
            self.said = (self.said + process.stdout.read()).decode()
        self.code = process.returncode


HEAD = """
import ctypes, hashlib, sys, time
from pathlib import Path
from torchmembrane import interruption
from torchmembrane.interruption import ended_by_signals, frame_in_work, unfinished, unstoppable

def compiled(seconds):
    until = time.monotonic() + seconds
    hashlib.pbkdf2_hmac("sha256", b"a", b"b", int(1e6 * seconds))  # does not return to Python for some seconds

try:
    with ended_by_signals(), unfinished(Path(sys.argv[1]) / "part"):
        (Path(sys.argv[1]) / "part").write_text("half")
        print("ready", flush=True)
        {body}
except KeyboardInterrupt as error:
    print("closed", flush=True)
    sys.exit(128 + error.number)
"""


def script(body: str, folder: Path) -> list[str]:
    return ["-c", HEAD.replace("{body}", body.strip().replace("\n", "\n        ")), str(folder)]


WORK = {
    "asleep": "time.sleep(60)",
    "in Python": "while True: pass",
    "in C": "compiled(30)",
    "compiling": "with unstoppable(): compiled(30)",
    "compiling for a frame": "with frame_in_work(), unstoppable(): compiled(30)",
    "callback": "call = ctypes.CFUNCTYPE(None)(lambda: time.sleep(5))\nfor _ in range(9): call()",
    "finalizer": "class Sleeper:\n    def __del__(self): time.sleep(5)\nfor _ in range(9): Sleeper()",
    "reading": "sys.stdin.read() or time.sleep(60)",
    "waiting": "import threading; threading.Event().wait()",
}


@pytest.mark.parametrize(
    "number, body",
    [
        pytest.param(number, body, id=f"{name}-{number.name}", marks=[] if k % 2 == quick else [pytest.mark.full])
        for k, (name, body) in enumerate(WORK.items())
        for quick, number in enumerate((signal.SIGINT, signal.SIGTERM))
    ],
)
def test_a_signal_ends_whatever_is_done_and_removes_its_part(number, body, tmp_path):
    ended = Ended(script(body, tmp_path), number, delay=0.2)  # within the body: between two finalizers one more may run
    assert ended.code == 128 + number and ended.seconds < SLOW and "Traceback" not in ended.said, ended.said
    assert list(tmp_path.iterdir()) == []


def test_the_computation_of_a_frame_is_waited_for_but_not_for_ever(tmp_path):
    body = "interruption.PATIENCE = 0.1\nwith frame_in_work(): compiled(1)\ntime.sleep(60)"
    ended = Ended(script(body, tmp_path), signal.SIGTERM, delay=0.2)  # within the frame
    assert ended.code == 143 and "closed" in ended.said
    body = "interruption.LONGER = 0.5\nwith frame_in_work(): compiled(60)"
    ended = Ended(script(body, tmp_path), signal.SIGTERM, delay=0.5)  # before the frame begins, it would be closed
    assert ended.code == 143 and "closed" not in ended.said and list(tmp_path.iterdir()) == []


CLOSING = "try: print('inside', flush=True); time.sleep(60)\nfinally: time.sleep({seconds}); print('whole', flush=True)"


@FIRST
def test_what_is_closed_is_not_disturbed_by_a_signal_that_comes_twice_at_once(number, tmp_path):
    ended = Ended(script(CLOSING.format(seconds=0.6), tmp_path), number, "inside", again=0.05)
    assert ended.code == 128 + number and "whole" in ended.said and "closed" in ended.said


@LAST
def test_a_second_signal_ends_the_process_at_once(number, tmp_path):
    ended = Ended(script(CLOSING.format(seconds=60), tmp_path), number, "inside", again=0.6)
    assert ended.code == 128 + number and ended.seconds < SLOW and "whole" not in ended.said
    assert list(tmp_path.iterdir()) == [] and "interrupted; what is done so far is kept" in ended.said


def test_closing_that_hangs_and_an_exception_that_is_swallowed_end_in_time(tmp_path):
    for body in (CLOSING.format(seconds=60), "try: print('inside', flush=True); time.sleep(60)\nexcept: time.sleep(60)"):
        ended = Ended(script(f"interruption.LONGER = 0.5\n{body}", tmp_path), signal.SIGTERM, "inside")
        assert ended.code == 143 and ended.seconds < SLOW


@BOTH
def test_a_signal_is_held_back_while_processes_start(number):
    with pytest.raises(Interrupted) as raised, ended_by_signals() as come:
        with starting_processes():
            signal.raise_signal(number)
            started = True
    assert started and raised.value.number == come() == number


@BOTH
def test_handlers_are_as_before_afterwards(number):
    before, hook = signal.getsignal(number), sys.unraisablehook
    with ended_by_signals() as come:
        assert signal.getsignal(number) != before
    assert (signal.getsignal(number), sys.unraisablehook, come()) == (before, hook, 0)
    assert signal.set_wakeup_fd(-1) == -1


@BOTH
@pytest.mark.parametrize("error", [ValueError("closing a file"), OSError(9, "a file"), None])
def test_a_command_says_interrupted_whatever_the_interruption_became(number, error, monkeypatch, capsys):
    def run(arguments):
        try:
            signal.raise_signal(number)
        finally:
            if error is not None:
                raise error

    monkeypatch.setattr(check, "run", run)
    assert main(["check", "a.toml"]) == 128 + number
    assert capsys.readouterr().err.endswith("torchmembrane: interrupted; what is done so far is kept\n")


def test_other_errors_are_not_taken_for_interruptions(monkeypatch):
    monkeypatch.setattr(check, "run", lambda arguments: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main(["check", "a.toml"])


@FIRST
def test_a_command_ends_while_machine_code_is_compiled(number, small_sensor, small_images, tmp_path):
    for k in range(3):
        (tmp_path / f"{k}.png").hardlink_to(small_images[0])
    (tmp_path / "cache").mkdir()
    command = ["-m", "torchmembrane", "live", small_sensor / "sensor.toml", "--images", tmp_path]
    ended = Ended(command, number, "compiling machine code", 2.0, NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    assert ended.code == 128 + number and ended.seconds < SLOW and "Traceback" not in ended.said, ended.said
    assert "ignored" not in ended.said


@LAST
def test_a_camera_that_never_opens_is_left(number, small_sensor, tmp_path):
    pytest.importorskip("cv2")
    os.mkfifo(tmp_path / "camera")
    code = "import cv2, sys; print('ready', flush=True); from torchmembrane.cli.main import main; sys.exit(main())"
    command = ["-c", code, "live", small_sensor / "sensor.toml", "--camera", tmp_path / "camera"]
    ended = Ended(command, number, delay=4.0)
    assert ended.code == 128 + number and ended.seconds < SLOW and "Traceback" not in ended.said, ended.said


STARTS = {
    "reconstruct": ("reconstruct", "SENSOR", "IMAGES", "--out", "OUT", "--workers", "2", "--figures"),
    "simulate": ("simulate", "SENSOR", "--random", "9", "--jobs", "2", "--out", "OUT"),
    "check": ("check", "SENSOR", "--accuracy", "--jobs", "2", "--out", "OUT"),
}
SAYING = """
import sys
from torchmembrane import interruption
from torchmembrane.cli.main import main
blocked = interruption._blocked
def say():
    print("ready", flush=True)
    return blocked()
if __name__ == "__main__":
    interruption._blocked = say
    sys.exit(main())
"""


ENDS = {"Ctrl-C": (signal.SIGINT, True), "SIGTERM": (signal.SIGTERM, False)}
QUICK = {("reconstruct", "Ctrl-C"), ("simulate", "Ctrl-C")}
"""The workers of `check` start as those of `simulate` do; Ctrl-C reaches the workers too."""


@pytest.mark.parametrize(
    "command, number, group",
    [
        pytest.param(command, *ENDS[end], id=f"{name}, {end}", marks=[] if (name, end) in QUICK else [pytest.mark.full])
        for name, command in STARTS.items()
        for end in ENDS
    ],
)
def test_worker_processes_that_start_end_with_the_command(command, number, group, small_sensor, small_images, tmp_path):
    (tmp_path / "images").mkdir()
    for k in range(9):
        (tmp_path / "images" / f"{k}.png").hardlink_to(small_images[0])
    (tmp_path / "main.py").write_text(SAYING)
    names = {"SENSOR": small_sensor / "sensor.toml", "IMAGES": tmp_path / "images", "OUT": tmp_path / "out.png"}
    delay = 0.0 if group else 1.0
    ended = Ended([tmp_path / "main.py", *(names.get(part, part) for part in command)], number, delay=delay, group=group)
    assert ended.code == 128 + number and ended.seconds < SLOW and ended.left == [], ended.said
    assert "Traceback" not in ended.said and "leaked" not in ended.said, ended.said
    assert not list(tmp_path.rglob(".*partial"))
