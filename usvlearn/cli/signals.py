"""Signals: SIGINT (Ctrl-C) and SIGTERM end a process with no file half-written. A second one ends it at once.

A signal raises `Stopped` where it arrives: reading, compiling, tuning and evaluating have nothing to lose. A replay is
different: `until_stopped` lets it finish its chunk and save. A worker of a sweep receives the signal from the process
that started it, and stays alive, because the launcher kills the other workers when one of them ends.
"""

from __future__ import annotations

import _thread
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

PERIOD = 0.2  # s between two checks for a signal that is to be passed on to workers
DELAY = 0.02  # s after which a signal that cannot be handled now is sent again
SHOW_CURSOR = "\x1b[?25h"  # a progress bar hides it
T = TypeVar("T")


class Stopped(BaseException):
    """A signal asked this process to end. It is not an Exception, so it is never recorded as a failure."""

    def __init__(self, number: int):
        super().__init__("stopped")
        self.code = 128 + number
        self.folder: Path | None = None  # of the run that was stopped, if one had begun


class _Process:
    """The state of the signal handler; there is one, because signals belong to a process."""

    received: int | None = None  # the first signal
    delayed = False  # whether the signal will be sent again
    at_once = False  # whether a signal raises where it arrives
    program = False  # whether this is the process that the user started, not a worker


def _receive(number: int, frame: FrameType | None) -> None:
    if _Process.delayed:
        _Process.delayed = False
    elif _Process.received is None:
        _Process.received = number
    else:
        if _Process.program:
            _end(number)
        return
    if _Process.at_once and _called_by_llvm(frame):
        _Process.delayed = True
        threading.Timer(DELAY, _thread.interrupt_main, [number]).start()  # the same signal again
    else:
        check_stopped()


def _called_by_llvm(frame: FrameType | None) -> bool:
    """Whether LLVM has called this Python code: an error raised there is printed and lost, and compiling fails."""
    while frame is not None and frame.f_code.co_name not in ("_raw_object_cache_notify", "_raw_object_cache_getbuffer"):
        frame = frame.f_back
    return frame is not None


def _end(number: int) -> None:
    """Exit at once. All files on the disk are complete, since files are replaced atomically."""
    for worker in multiprocessing.active_children():
        worker.kill()
    if sys.stdout is not None and sys.stdout.isatty():
        os.write(sys.stdout.fileno(), SHOW_CURSOR.encode())
    os._exit(128 + number)


def check_stopped() -> None:
    """Raise `Stopped` if a signal has arrived and nothing defers it."""
    if _Process.received is not None and _Process.at_once:
        raise Stopped(_Process.received)


@contextmanager
def stoppable() -> Iterator[None]:
    """Let SIGINT and SIGTERM raise `Stopped` in this block; handlers that other code has set are kept."""
    _Process.program, _Process.received, _Process.at_once = True, None, True
    before = _install(_receive)
    try:
        yield
    finally:
        _Process.program, _Process.received, _Process.at_once = False, None, False
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def stoppable_worker() -> Iterator[None]:
    """Let the program's SIGTERM raise `Stopped` in this block of a worker, or at its start if it came earlier.

    A worker ignores Ctrl-C, because the program receives it, too. After the block no signal ends the worker. If the
    launcher has its own handler, as Slurm's has, the launcher handles both signals.
    """
    _shield_requeue()
    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        _install(_receive, signal.SIG_IGN)
    _Process.at_once = True
    try:
        check_stopped()
        yield
    finally:
        _Process.at_once = False


def _shield_requeue() -> None:
    """Let the command with which submitit queues this job again outlive SIGTERM.

    Slurm sends SIGTERM to all processes of a job that is queued again, so to that command, too. When it died of it, an
    error was raised here, and the job counted as failed.
    """
    number = getattr(signal, "SIGUSR2", None)
    handler = signal.getsignal(number) if number else None
    if number is None or not callable(handler) or getattr(handler, "__wrapped__", None):
        return

    @wraps(handler)
    def shielded(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a command that is started now inherits this
        handler(number, frame)

    signal.signal(number, shielded)


def _install(on_terminate: Any, on_interrupt: Any = None) -> dict[int, Any]:
    """Replace default handlers and return them; a handler that other code has set is kept."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    wanted: dict[int, Any] = {signal.SIGTERM: on_terminate, signal.SIGINT: on_interrupt or on_terminate}
    before: dict[int, Any] = {number: signal.getsignal(number) for number in wanted}
    before = {number: each for number, each in before.items() if each in (signal.SIG_DFL, signal.default_int_handler)}
    for number in before:
        signal.signal(number, wanted[number])
    return before


def in_program() -> bool:
    """Whether this is the process that the user started, not one of its workers."""
    return _Process.program


def defer_signals() -> None:
    """Defer signals until `end_deferral`: workers finish their chunk, and their launcher then ends by itself."""
    _Process.at_once = False
    threading.Thread(target=_tell_workers, daemon=True).start()


def _tell_workers() -> None:
    """Pass a signal on to all workers as SIGTERM, also to those that start later; each reacts to the first."""
    while _Process.program and not _Process.at_once:
        time.sleep(PERIOD)
        if _Process.received is not None:
            for worker in multiprocessing.active_children():
                worker.terminate()


def end_deferral() -> None:
    """End the deferral of `defer_signals`: raise `Stopped` if a signal has arrived in the meantime."""
    _Process.at_once = True
    check_stopped()


def was_stopped() -> Stopped | None:
    """The `Stopped` of a signal that has arrived in this program, or None."""
    return None if _Process.received is None else Stopped(_Process.received)


def until_stopped(chunks: Iterable[T], save: Callable[[], object]) -> Iterator[T]:
    """Yield chunks; once a signal arrives, finish the chunk and its use, call `save`, and raise `Stopped`.

    Before the first chunk, code is compiled and nothing has been learned: a signal then raises at once.
    """
    chunks, before = iter(chunks), _Process.at_once
    try:
        for chunk in chunks:
            _Process.at_once = False
            yield chunk
            if _Process.received is not None:
                save()
                break
    finally:
        _Process.at_once = before
    check_stopped()
