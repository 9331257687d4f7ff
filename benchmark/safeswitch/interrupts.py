"""Ctrl-C without a screenful of tracebacks: it is for this process, which then ends its workers."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def for_this_process_alone() -> Iterator[None]:
    """Keep Ctrl-C from processes that are started inside; here it is KeyboardInterrupt as ever.

    A terminal sends SIGINT to every process of the command. Processes inherit the signal mask of the thread that
    starts them, so SIGINT is blocked in this thread, and received by a thread that does nothing else: Python runs the
    handler in the main thread whichever thread received the signal.
    """
    if not hasattr(signal, "pthread_sigmask") or threading.current_thread() is not threading.main_thread():
        yield
        return
    over = threading.Event()

    def listen() -> None:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        over.wait()

    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    listener = threading.Thread(target=listen, name="SIGINT", daemon=True)
    listener.start()
    try:
        yield
    finally:
        over.set()
        listener.join()
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
