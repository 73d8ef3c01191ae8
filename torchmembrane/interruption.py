"""Ctrl-C and SIGTERM end a command promptly, whatever it is doing.

The first signal raises `Interrupted` in the main thread, as Python raises KeyboardInterrupt for Ctrl-C. A watching thread
ensures that this ends the command. If the exception is lost in a callback, it is raised again. If the main thread does not end
in time, for instance because it is in compiled code that does not return, or if a second signal arrives, the process is ended;
its unfinished files are removed and its child processes are ended.
"""

import os
import shutil
import signal
import socket
import sys
from _thread import interrupt_main
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from select import select
from threading import Thread, current_thread, main_thread
from time import monotonic
from typing import Any, NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM)
SAID = "torchmembrane: interrupted; what is done so far is kept"
PATIENCE = 1.5
"""Seconds after a signal until the process is ended if the main thread has not responded."""
LONGER = 10.0
"""The same limit while a frame is computed, and for the clean-up after the exception."""
AGAIN = 0.5
"""Share of these times after which the exception is raised once more."""
APART = 0.3
"""Seconds within which several signals count as one: a process group may receive a signal twice."""
LOOK = 0.05
"""Seconds between two checks of how a signal was handled."""


class Interrupted(KeyboardInterrupt):
    """The exception that a signal raises.

    Attributes:
        number: number of the signal.
    """

    def __init__(self, number: int):
        super().__init__()
        self.number = number


class _State:
    """The state of signal handling in one command.

    Attributes:
        number: number of the first signal; 0 before one has arrived.
        answered: whether the main thread has received the signal and is ending.
        raised: whether it has received the signal as an exception.
        lost: whether the exception was lost, for example in a callback.
        held: number of nested `starting_processes` blocks that delay the signal.
    """

    def __init__(self) -> None:
        self.number, self.held = 0, 0
        self.answered = self.raised = self.lost = False

    def on_signal(self, number: int, _: object) -> None:
        """Raise the exception for the first signal only: later ones must not disturb the clean-up."""
        self.number = self.number or number
        if not self.answered and not self.held:
            self.answered = self.raised = True
            raise Interrupted(self.number)

    def patience(self) -> float:
        """Return the seconds from the signal until the process is ended."""
        return LONGER if not _unstoppable and (self.answered or _frames) else PATIENCE


_state = _State()
_unstoppable: set[object] = set()
_frames: set[object] = set()
_unfinished: set[Path] = set()


@contextmanager
def ended_by_signals() -> Iterator[Callable[[], int]]:
    """Within the block, let SIGINT and SIGTERM raise `Interrupted` in the main thread or end the process; no effect in other
    threads.

    Yields:
        A function that returns the number of the signal whose exception was raised; 0 without one.
    """
    global _state
    state = _state = _State()
    if current_thread() is not main_thread():
        yield lambda: 0
        return
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    hook, before = sys.unraisablehook, {number: signal.signal(number, state.on_signal) for number in SIGNALS}
    fd = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)

    def on_unraisable(unraisable: Any) -> None:
        if issubclass(unraisable.exc_type, Interrupted):
            state.answered, state.lost = False, True
        else:
            hook(unraisable)

    sys.unraisablehook = on_unraisable
    Thread(target=_watch, args=(state, reader), name="signals", daemon=True).start()
    try:
        yield lambda: state.number if state.raised else 0
    finally:
        signal.set_wakeup_fd(fd)
        for number, handler in before.items():
            signal.signal(number, handler)
        sys.unraisablehook = hook
        writer.close()


def answer() -> None:
    """Declare that the main thread has noticed the signal and is ending, so that the exception is not raised again."""
    _state.answered = True


@contextmanager
def unstoppable() -> Iterator[None]:
    """Mark code, in any thread, that does not return to Python for a long time: a signal within the block ends the process."""
    with _within(_unstoppable):
        yield


@contextmanager
def frame_in_work() -> Iterator[None]:
    """Mark the computation of frames, which may take longer than `PATIENCE`: a signal in it allows `LONGER`."""
    with _within(_frames):
        yield


@contextmanager
def unfinished(path: Path) -> Iterator[None]:
    """Remove an unfinished file or folder at the end of the block, even if the process is ended within it."""
    _unfinished.add(path)
    try:
        yield
    finally:
        _remove(path)
        _unfinished.discard(path)


def remove_unfinished() -> None:
    """Remove all unfinished files of this process."""
    for path in list(_unfinished):
        _remove(path)


@contextmanager
def starting_processes() -> Iterator[None]:
    """Delay a signal until the processes started in the block are running, and shield them from Ctrl-C.

    A process that is interrupted while it starts would print a traceback; one that its parent does not know yet would be left
    running.
    """
    state = _state
    state.held += 1
    try:
        with _blocked() if hasattr(signal, "pthread_sigmask") else nullcontext():
            yield
    finally:
        state.held -= 1
    if state.number and current_thread() is main_thread():
        state.on_signal(state.number, None)


def end_process(number: int) -> NoReturn:
    """Print a message and end this process and its children, without Python's usual clean-up, which takes long.

    Args:
        number: number of the signal that was received.
    """
    os.write(2, f"{SAID}\n".encode())
    if "multiprocessing" in sys.modules:
        for process in sys.modules["multiprocessing"].active_children():
            process.kill()
    remove_unfinished()
    os._exit(128 + number)


def _watch(state: _State, reader: socket.socket) -> None:
    """End the process if the main thread does not end in time, or if a second signal arrives."""
    with reader:
        number = 0
        while number not in SIGNALS:  # others have handlers of their own
            if not (come := reader.recv(1)):
                return
            number = come[0]
        begun = latest = monotonic()
        while True:
            if select([reader], [], [], LOOK)[0]:
                if not reader.recv(64):
                    return
                if monotonic() - latest > APART:
                    end_process(number)
            after = monotonic() - begun
            if after > state.patience():
                end_process(number)
            elif state.lost or (after > AGAIN * state.patience() and not state.answered):
                state.lost, latest = False, monotonic()
                interrupt_main(signal.Signals(number))


@contextmanager
def _blocked() -> Iterator[None]:
    """Shield processes that are started within the block from Ctrl-C: they inherit this thread's blocked signal."""
    from multiprocessing.resource_tracker import ensure_running

    ensure_running()  # it would let the signal in again
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@contextmanager
def _within(those: set[object]) -> Iterator[None]:
    mark = object()
    those.add(mark)
    try:
        yield
    finally:
        those.discard(mark)


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError:  # a folder, or in one that may not be changed
        shutil.rmtree(path, ignore_errors=True)
