"""The command line: `dano train | data | import | build | inspect | simulate | …`, see `dano --help`."""

import contextlib
import os
import sys
import warnings
from collections.abc import Sequence
from typing import NoReturn


def main(argv: Sequence[str] | None = None) -> None:
    """Run a command.

    Exits with code 2 after a one-line message if the input is wrong, with 130 if interrupted.

    Args:
        argv: Arguments without the program's name; default those of the process, which then also keeps what
            it compiles for the next one (see `dano.programs`).
    """
    # Here and below: what a command needs is imported when it runs, so that `dano --help` answers at once.
    from dano.cli._console import end_line, say
    from dano.cli._interrupt import interrupted, listening

    with listening():
        try:
            _run(list(sys.argv[1:] if argv is None else argv), keep=argv is None)
            if interrupted():
                raise KeyboardInterrupt
        except KeyboardInterrupt as stop:
            end_line()
            say("; ".join(["interrupted", *map(str, stop.args)]))
            _leave(130, at_once=argv is None)
        except Exception as error:
            end_line()
            if interrupted():
                # Whatever went wrong then is a consequence.
                say("interrupted")
                _leave(130, at_once=argv is None)
            if not isinstance(error, (ValueError, ImportError, OSError, MemoryError)):
                raise
            say("error: " + (" ".join(str(error).split()) or "out of memory"))
            raise SystemExit(2) from error


def _leave(code: int, *, at_once: bool) -> NoReturn:
    """End with a code; `at_once`: without Python's clearing up.

    XLA may still be compiling in threads of its own, which that would crash.
    """
    if not at_once:
        raise SystemExit(code)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _run(argv: list[str], keep: bool) -> None:
    """Run a command; `keep`: keep what it compiles."""
    from dano.cli._parse import parse, run

    command = parse(argv)
    import jax

    from dano.cli._console import say
    from dano.cli._outputs import named
    from dano.programs import keep_programs

    jax.config.update("jax_enable_x64", True)
    # Called from another program, JAX's settings are that program's.
    with warnings.catch_warnings(), contextlib.ExitStack() as end:
        warnings.showwarning = _say_warning
        # What dano says of its results is heard whatever the process makes of warnings, once.
        warnings.simplefilter("default", UserWarning)
        if keep:
            # Not when the process ends, which it may do at once.
            end.callback(keep_programs())
        command, line = named(command)
        run(command)
        if line is not None:
            say(line)


def _say_warning(message: Warning | str, *_: object, **__: object) -> None:
    from dano.cli._console import end_line, say

    end_line()
    say(f"warning: {message}")
