"""Pages in the browser: served until they are stopped, or written as one file that needs no server."""

import contextlib
import io
import os
import threading
from collections.abc import Callable
from functools import partial
from typing import Any

from dano.archive import checked_output, replacing
from dano.checks import checked_count, checked_text
from dano.report._video import require


class Viewer:
    """A running page; `stop` ends it.

    Attributes:
        port: Where it listens.
        url: Its address on this machine.
    """

    port: int
    url: str

    def __init__(self, server: Any, end: Callable[[], None] | None = None):
        """Made by `view`, `view_field` and `view_capture`.

        Args:
            server: Of viser, with all that it shows.
            end: Ends what moves it.
        """
        self._server, self._end = server, end
        self.port = server.get_port()
        self.url = f"http://localhost:{self.port}"
        self._stopped = threading.Event()

    def stop(self) -> None:
        """End the page; calling it again does nothing."""
        if self._stopped.is_set():
            return
        self._stopped.set()
        if self._end is not None:
            self._end()
        _quietly(self._server.stop)

    def wait(self) -> None:
        """Serve until interrupted (Ctrl-C), then stop."""
        with contextlib.suppress(KeyboardInterrupt):
            while not self._stopped.wait(0.2):
                pass
        self.stop()


def checked_address(port: int, host: str) -> None:
    """Check where to listen.

    Raises:
        ValueError: If the port is not one, or the host is not text.
    """
    checked_count("port", port, most=65535)
    checked_text("host", host)


def serve(fill: Callable[[Any], Callable[[], None] | None], *, port: int, host: str, block: bool) -> Viewer:
    """Serve a page.

    Args:
        fill: Fills a server, and gives what ends that which moves it.
        port: Where to listen; the next free one if it is taken.
        host: Address to listen at.
        block: Whether to serve until interrupted.

    Raises:
        ValueError: If the port is not one, or the host is not text.
        ImportError: If viser is missing.
    """
    checked_address(port, host)
    server = _opened(host=host, port=int(port), label="dano")
    try:
        end = fill(server)
    except BaseException:
        _quietly(server.stop)
        raise
    viewer = Viewer(server, end)
    if block:
        print(f"viewer at {viewer.url} (Ctrl-C ends it)", flush=True)
        viewer.wait()
    return viewer


def write_file(path: str | os.PathLike[str], fill: Callable[[Any], str]) -> None:
    """Write a page as one file, whole or not at all.

    Args:
        path: Where to.
        fill: Fills a server, and gives the page.

    Raises:
        ValueError: If the path is a directory or lies in none.
    """
    target = checked_output(path)
    server = _opened(host="127.0.0.1")
    try:
        page = fill(server)
    finally:
        _quietly(server.stop)
    with replacing(target) as file:
        file.write(page.encode())


def _opened(**options: Any) -> Any:
    return _quietly(partial(require("viser").ViserServer, verbose=False, **options))


def _quietly(call: Callable[[], Any]) -> Any:
    """What a call returns, without what viser prints of its server."""
    with contextlib.redirect_stdout(io.StringIO()):
        return call()
