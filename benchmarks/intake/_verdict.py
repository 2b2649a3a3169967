"""What becomes of a file: one of four words."""

import enum
import warnings
from collections.abc import Callable
from typing import Any


class Outcome(enum.Enum):
    """What became of a file."""

    LOADS = "loads"
    REFUSED_RIGHTLY = "refused rightly"
    REFUSED_WRONGLY = "refused wrongly"
    WRONG = "read wrongly"


Case = tuple[str, Callable[[], Outcome]]
"""Name of a case, and what tries it and says the verdict."""


def verdict(read: Callable[[], Any], is_right: Callable[[Any], bool] | None) -> Outcome:
    """Try to read something.

    Args:
        read: Reads it; a ValueError or ImportError of one line is a refusal, anything else that is raised
            counts as read wrongly.
        is_right: Whether what was read is what the file means; None if it must be refused.
    """
    with warnings.catch_warnings():
        # What is corrected and guessed is said; here only what comes out counts.
        warnings.simplefilter("ignore", UserWarning)
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            found = read()
        except (ValueError, ImportError):
            return Outcome.REFUSED_RIGHTLY if is_right is None else Outcome.REFUSED_WRONGLY
        except Exception:  # a traceback is not an answer
            return Outcome.WRONG
    return Outcome.LOADS if is_right is not None and is_right(found) else Outcome.WRONG
