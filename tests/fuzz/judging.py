"""What became of a call with bad input."""

import contextlib
import signal
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Literal, NamedTuple

Verdict = Literal["clear", "unclear", "traceback", "silently wrong"]
VERDICTS: tuple[Verdict, ...] = ("clear", "unclear", "traceback", "silently wrong")
LONGEST = 600
"""Characters of a message that is still read."""


LIMIT = 20
"""Seconds after which bad input counts as taken: work has begun."""


class Outcome(NamedTuple):
    """A case and what became of it."""

    case: str
    verdict: Verdict
    told: str


class TookTooLongError(BaseException):
    """Work began although the input was bad."""


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """Raise `TookTooLongError` when the block takes longer than `LIMIT`."""

    def ring(*_: object) -> None:
        raise TookTooLongError

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(LIMIT)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def judge(
    case: str,
    function: Callable[..., object],
    arguments: Mapping[str, object],
    says: str,
    *,
    positional: bool = False,
) -> Outcome:
    """Call a function with bad input; a clear answer is one line of dano's own that says what is wrong."""
    try:
        with warnings.catch_warnings(), limited():
            warnings.simplefilter("ignore")
            if positional:
                function(*arguments.values())
            else:
                function(**arguments)
    except (ValueError, ImportError) as error:
        told = f"{type(error).__name__}: {error}"
        place = traceback.extract_tb(error.__traceback__)[-1].filename
        own = "/src/dano/" in place.replace("\\", "/")
        one_line = "\n" not in told and len(told) <= LONGEST
        return Outcome(case, "clear" if own and one_line and says in str(error) else "unclear", told)
    except TookTooLongError:
        return Outcome(case, "silently wrong", f"worked for {LIMIT} s")
    except Exception as error:  # whatever it is: it is what the user would see
        return Outcome(case, "traceback", f"{type(error).__name__}: {error}".splitlines()[0])
    return Outcome(case, "silently wrong", "no error")
