"""Ctrl-C is heard once and for all.

Python raises KeyboardInterrupt wherever it happens to be; in a finaliser or a callback it is printed and
lost, and the command would go on and end as if nothing had been. So the signal is remembered, too.
"""

import contextlib
import signal
import threading
from collections.abc import Iterator

_heard = threading.Event()


def interrupted() -> bool:
    """Whether this command was interrupted."""
    return _heard.is_set()


@contextlib.contextmanager
def listening() -> Iterator[None]:
    """Remember interrupts while the block runs; they raise KeyboardInterrupt as ever."""
    _heard.clear()
    # Whoever ignores or handles interrupts, such as nohup or an application around this one, keeps doing so.
    usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not usual or threading.current_thread() is not threading.main_thread():
        yield
        return

    def hear(number: int, frame: object) -> None:
        _heard.set()
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, hear)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
