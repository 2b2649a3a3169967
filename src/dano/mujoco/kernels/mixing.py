"""Parameters of contacts: mixed as MuJoCo mixes those of geoms, harder where bodies would sink too deep."""

import warp as wp

from dano.mujoco.kernels.tables import ContactRow, Known, Model, Options, PartIndex, Settings, vec2, vec5
from dano.physics.real import ONE, real, TWO, ZERO

LEAST_FRICTION = 1e-5
"""MuJoCo's mjMINMU."""

_LEAST_FRICTION = wp.constant(real(LEAST_FRICTION))
# MuJoCo's mjMINVAL.
_LEAST_WEIGHT = wp.constant(real(1e-15))
# Base of the natural logarithm: a critically damped spring with time constant T lets what hits it at v sink
# in by v T / e.
_E = wp.constant(real(2.718281828459045))
# Samples for which a contact counts at most: MuJoCo's solver slows down where compliances differ too much.
_MOST_SAMPLES = wp.constant(real(6.0))
# The same where two flat faces meet, all contacts of which are as compliant: a tower of soft ones buckles.
_MOST_FLAT = wp.constant(real(30.0))
# Share of the way of a step by which contacts that come into being early lie within their margin.
_INSIDE = wp.constant(real(1e-3))
# Impedance of contacts that are to end an approach within the step.
_HARD = wp.constant(real(0.99))


@wp.func
def do_touch(model: wp.ref[Model], a: PartIndex, b: PartIndex) -> bool:
    """Whether the bits of two parts let them touch."""
    contype = model.geom_contype[a.geom]
    conaffinity = model.geom_conaffinity[a.geom]
    if a.is_object == 1:
        contype = a.contype
        conaffinity = a.conaffinity
    return (contype & b.conaffinity) != 0 or (b.contype & conaffinity) != 0


@wp.func
def mixed(model: wp.ref[Model], options: Options, world: int, a: int, b: int) -> Settings:
    """What MuJoCo takes for two of its geoms, by priority, solmix and size. Margins and gaps add up."""
    found = Settings()
    found.gap = model.geom_gap[world, a] + model.geom_gap[world, b]
    found.margin = model.geom_margin[world, a] + model.geom_margin[world, b] + options.beyond * found.gap
    dim = wp.max(model.geom_condim[a], model.geom_condim[b])
    weight = model.geom_solmix[world, a] + model.geom_solmix[world, b]
    share = real(0.5)
    if weight > _LEAST_WEIGHT:
        share = model.geom_solmix[world, a] / weight
    friction = wp.max(model.geom_friction[world, a], model.geom_friction[world, b])
    same = model.geom_priority[a] == model.geom_priority[b]
    if not same:
        leader = a
        share = ONE
        if model.geom_priority[b] > model.geom_priority[a]:
            leader = b
            share = ZERO
        dim = model.geom_condim[leader]
        friction = model.geom_friction[world, leader]
    first = model.geom_solref[world, a]
    second = model.geom_solref[world, b]
    found.solref = share * first + (ONE - share) * second
    if same and (first[0] <= ZERO or second[0] <= ZERO):
        found.solref = wp.min(first, second)
    found.solimp = share * model.geom_solimp[world, a] + (ONE - share) * model.geom_solimp[world, b]
    sliding = wp.max(friction[0], _LEAST_FRICTION)
    rolling = wp.max(friction[2], _LEAST_FRICTION)
    found.friction = vec5(sliding, sliding, wp.max(friction[1], _LEAST_FRICTION), rolling, rolling)
    found.dim = real(dim)
    return found


@wp.func
def pair_settings(
    known: wp.ref[Known],
    model: wp.ref[Model],
    options: Options,
    given: wp.array(dtype=Settings),
    world: int,
    pair: int,
) -> Settings:
    """Parameters of a pair, of no direction where its parts do not touch."""
    found = Settings()
    if options.given > ZERO:
        found = given[pair]
    else:
        a = known.index[known.pairs[pair].first]
        b = known.index[known.pairs[pair].second]
        if do_touch(model, a, b):
            found = mixed(model, options, world, a.geom, b.geom)
            if options.overridden > ZERO:
                found.friction = given[0].friction
                found.solref = given[0].solref
                found.solimp = given[0].solimp
                found.margin = given[0].margin + options.beyond * found.gap
    return found


@wp.func
def stiffened(impedance: real, samples: real) -> real:
    """Impedance of one contact that is as compliant as several in parallel: (1 − d)/d over their number."""
    return samples * impedance / (ONE + (samples - ONE) * impedance)


@wp.func
def in_parallel(settings: Settings, samples: real, flat: bool) -> Settings:
    """Parameters of a contact that stands for so many samples; `flat`: of two faces."""
    found = settings
    n = wp.min(samples, wp.where(flat, _MOST_FLAT, _MOST_SAMPLES))
    imp = settings.solimp
    found.solimp = vec5(stiffened(imp[0], n), stiffened(imp[1], n), imp[2], imp[3], imp[4])
    return found


@wp.func
def held_back(row: ContactRow, nearing: real, h: real) -> ContactRow:
    """A contact that is to touch by the end of the step, for a solver that takes none beyond its margin.

    It lies just within the margin, without a spring. Its damper alone leads to v⁺ = −gap/h, as the spring of
    `softened` does: −b v with b = (1 − gap/(h v))/h. Friction keeps that one's damping.

    Args:
        row: As `softened` has it.
        nearing: v, the speed at which the gap closes [m/s].
        h: Timestep [s].
    """
    found = row
    gap = row.dist - row.includemargin
    # What does not touch by then stays beyond the margin, and unheard.
    if h * nearing > gap:
        found.dist = row.includemargin - _INSIDE * h * nearing
        found.solreffriction = row.solref
        found.solref = vec2(ZERO, row.solref[1] * (ONE - gap / (h * nearing)))
    return found


@wp.func
def softened(settings: Settings, gap: real, nearing: real, sink: real, h: real) -> Settings:
    """Parameters with which bodies sink into each other by no more than they may.

    Those of the pair where they do so. Otherwise time constant and compliance of its spring are scaled by
    the share that does, down to what a step resolves: two steps, as MuJoCo itself asks. A spring between
    bodies that do not touch yet lets them touch at the end of the step: v⁺ = −gap/h.

    Args:
        settings: Of the pair.
        gap: Between the bodies over the margin, negative where they overlap [m].
        nearing: Speed at which it closes [m/s].
        sink: How deep they may [m].
        h: Timestep [s].
    """
    found = settings
    room = sink + gap
    if gap > ZERO:
        # Negative numbers are stiffness and damping, divided by the impedance's top.
        found.solref = vec2(-_HARD / (h * h), -_HARD / h)
        found.solimp = vec5(_HARD, _HARD, settings.solimp[2], settings.solimp[3], settings.solimp[4])
    else:
        # Ordinary down to half of the way.
        share = wp.clamp(TWO * room / sink, ZERO, ONE)
        time = settings.solref[0]
        sinks = ONE / _E
        if settings.solref[0] <= ZERO:
            # Negative numbers are stiffness and damping: the inverse of a frequency, at worst undamped.
            time = ONE / wp.sqrt(wp.max(-settings.solref[0], _LEAST_WEIGHT))
            sinks = ONE
        if nearing * sinks * time * share > room:
            share = wp.clamp(room / (nearing * sinks * time), ZERO, ONE)
        if share < ONE:
            least = wp.min(ONE - _HARD, ONE - settings.solimp[1])
            top = ONE - wp.max(share * (ONE - settings.solimp[1]), least)
            bottom = ONE - wp.max(share * (ONE - settings.solimp[0]), least)
            found.solimp = vec5(bottom, top, settings.solimp[2], settings.solimp[3], settings.solimp[4])
            faster = time / wp.min(wp.max(share * time, TWO * h), time)
            if settings.solref[0] <= ZERO:
                found.solref = vec2(faster * faster * settings.solref[0], faster * settings.solref[1])
            else:
                found.solref = vec2(settings.solref[0] / faster, settings.solref[1])
    return found
