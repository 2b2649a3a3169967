"""The command line: `dano train | data | import | build | inspect | simulate | identify | view | demo`."""

import sys
import warnings
from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> None:
    """Run a command.

    Exits with code 2 after a one-line message if the input is wrong, with 130 if interrupted.

    Args:
        argv: Arguments without the program's name; default those of the process.
    """
    # Here and below: what a command needs is imported when it runs, so that `dano --help` answers at once.
    from dano.cli._parse import parse

    command = parse(list(sys.argv[1:] if argv is None else argv))
    import jax

    from dano.cli._console import end_line, say

    jax.config.update("jax_enable_x64", True)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _say_warning
            command()
    except (ValueError, ImportError, OSError) as error:
        end_line()
        say("error: " + " ".join(str(error).split()))
        raise SystemExit(2) from error
    except KeyboardInterrupt:
        end_line()
        say("interrupted")
        raise SystemExit(130) from None


def _say_warning(message: Warning | str, *_: object, **__: object) -> None:
    from dano.cli._console import end_line, say

    end_line()
    say(f"warning: {message}")
