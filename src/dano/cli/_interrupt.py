"""Ctrl-C, and being asked to end (SIGTERM), are heard once and for all.

Python raises KeyboardInterrupt wherever it happens to be; in a finaliser or a callback it is printed and
lost, and the command would go on and end as if nothing had been. So the signal is remembered, too.
"""

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator

_heard = threading.Event()


def interrupted() -> bool:
    """Whether this command was interrupted."""
    return _heard.is_set()


@contextlib.contextmanager
def listening() -> Iterator[None]:
    """Remember interrupts while the block runs; they raise KeyboardInterrupt as ever.

    Being asked to end is such an interrupt, too: what is half done is put away, not left.
    """
    _heard.clear()
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    # Whoever ignores or handles a signal, such as nohup or an application around this one, keeps doing so.
    ours = [number for number, handler in usual.items() if signal.getsignal(number) is handler]
    if threading.current_thread() is not threading.main_thread():
        ours = []

    def hear(number: int, frame: object) -> None:
        _heard.set()
        raise KeyboardInterrupt

    for number in ours:
        signal.signal(number, hear)
    before = sys.unraisablehook
    sys.unraisablehook = lambda told: None if _is_interrupt(told) else before(told)
    try:
        yield
    finally:
        sys.unraisablehook = before
        for number in ours:
            signal.signal(number, usual[number])


def _is_interrupt(told: object) -> bool:
    """Whether what Python could not raise is the interrupt, which is remembered, and needs no traceback."""
    return getattr(told, "exc_type", None) is KeyboardInterrupt and interrupted()
