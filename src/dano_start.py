"""Starts the command `dano`: stopped while Python still reads dano, it ends in one line, too."""

import os
import signal
from types import FrameType


def main() -> None:
    """Read dano, which takes a second or two, and run its command."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    ours = {number: handler for number, handler in usual.items() if signal.getsignal(number) is handler}
    for number in ours:
        signal.signal(number, _stop)
    from dano.cli import main as run

    # From here on the command listens itself, and clears up.
    for number, handler in ours.items():
        signal.signal(number, handler)
    run()


def _stop(number: int, frame: FrameType | None) -> None:
    del number, frame
    os.write(2, b"dano: interrupted\n")
    os._exit(130)


def register_environments() -> None:
    """Tell Gymnasium of its environments; it calls this when it is imported, so nothing slow is."""
    from gymnasium.envs.registration import register, registry

    if "dano/Scene-v0" not in registry:
        register(
            "dano/Scene-v0",
            entry_point="dano.gym:make_env_of_files",
            vector_entry_point="dano.gym:make_vector_env_of_files",
        )
