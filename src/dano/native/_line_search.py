"""The line search of a Newton step, as `dano.engine` describes it.

A search is six numbers: work of the residual along the step at the accepted point, share of the step to try,
the bracket of shares and the works at its ends.
"""

import math

from dano.native._compiling import lean

BEGUN, LENGTH, LOW, LOW_WORK, HIGH, HIGH_WORK = range(6)
"""Places in a search."""


@lean
def begin_search(begun, search):
    """Try the whole step first; the residual does the work `begun` along it at its beginning."""
    search[BEGUN], search[LENGTH] = begun, 1.0
    search[LOW], search[LOW_WORK], search[HIGH], search[HIGH_WORK] = 0.0, begun, 0.0, 0.0


@lean
def accepts(work, enough, give_up, search):
    """Whether a share of the step is good enough, see `Search.accepts` of `dano.engine`."""
    bracketed = search[HIGH] > 0.0
    limit = enough * abs(search[BEGUN])
    misses = work > limit or (bracketed and work < -limit) or math.isnan(work)
    close = bracketed and search[HIGH] - search[LOW] < give_up
    return not misses or close or search[BEGUN] >= 0.0


@lean
def narrow(work, search):
    """Bracket and next share of a line search after a miss, see `Search.narrowed` of `dano.engine`."""
    length, high = search[LENGTH], search[HIGH]
    if not work < 0.0:
        search[LOW_WORK] *= 0.5
        search[HIGH], search[HIGH_WORK] = length, work
    else:
        search[LOW], search[LOW_WORK] = length, work
        if high != 0.0:
            search[HIGH_WORK] *= 0.5
    portion = -search[LOW_WORK] / (search[HIGH_WORK] - search[LOW_WORK])
    portion = min(max(portion, 0.1), 0.9) if not math.isnan(portion) else 0.1
    search[LENGTH] = search[LOW] + portion * (search[HIGH] - search[LOW])
