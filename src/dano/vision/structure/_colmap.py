"""pycolmap: brought in when it is needed, quiet, and to be interrupted."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

from dano.extras import COLMAP, OPENCV

_POLL = 0.1
"""Seconds between looks at whether work has ended or was interrupted."""


def colmap() -> ModuleType:
    """The library.

    Raises:
        ImportError: If it is missing.
    """
    return COLMAP.load()


def opencv() -> ModuleType:
    """OpenCV.

    Raises:
        ImportError: If it is missing.
    """
    return OPENCV.load()


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """While the block runs, pycolmap prints nothing but fatal errors."""
    log = colmap().logging
    before = log.minloglevel
    log.minloglevel = 3
    try:
        yield
    finally:
        log.minloglevel = before


def interruptible(work: Callable[..., Any], *arguments: Any, poll: Callable[[], None], **named: Any) -> Any:
    """Run work of pycolmap beside this thread, which stays free to be interrupted.

    Args:
        work: A function of pycolmap that takes `cancellation_token`.
        *arguments: Its arguments.
        poll: Called now and then while it runs; what it raises stops the work.
        **named: Its arguments by name.

    Returns:
        What it returns.
    """
    token = colmap().CancellationToken()
    answer: list[Any] = []
    failure: list[BaseException] = []

    def run() -> None:
        try:
            answer.append(work(*arguments, cancellation_token=token, **named))
        except BaseException as error:  # handed to the thread that waits
            failure.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        while thread.is_alive():
            poll()
            thread.join(_POLL)
    except BaseException:
        token.cancel()
        # Nothing may read its files once they are removed.
        while thread.is_alive():
            time.sleep(_POLL)
        raise
    if failure:
        raise failure[0]
    return answer[0]
