"""What acts on joint coordinates in a step: the laws of `dano.engine.joints`, one coordinate at a time."""

import math

from dano.native._compiling import lean

# Columns of the table of laws, see `JointLaws` of `dano.scene`: what no joint has is 0, or endless.
DAMPING, ARMATURE, STIFFNESS, REST, FRICTION, LEAST, MOST = range(7)
GEAR, PULL, DRIVE, LEAST_EFFORT, MOST_EFFORT = range(7, 12)
# Rows of the ramps of a coordinate: friction, two limits, motor; columns of a ramp: slope, centre, least and
# most force, the speeds at which it reaches these, and there ρ y + g(y) with all ramps in g.
RAMPS, COLUMNS = 4, 8
_SLOPE, _CENTRE, _LOW, _HIGH, _BEGIN, _END, _AT_BEGIN, _AT_END = range(COLUMNS)


@lean
def _clip(x, low, high):
    # by real parts, for derivatives: see `_frames`
    return low if x.real < low.real else high if x.real > high.real else x


@lean
def smooth(laws, c, constant, q, v, effort, command, h, y):
    """Momentum that springs, damping, armature and efforts take: see `JointForces.smooth`."""
    momentum = h * (laws[c, DAMPING] * y - effort) + laws[c, ARMATURE] * (y - v)
    momentum += h * laws[c, STIFFNESS] * (q + 0.25 * h * (y - v) - laws[c, REST])
    if constant:
        momentum -= h * laws[c, GEAR] * _clip(command, laws[c, LEAST_EFFORT], laws[c, MOST_EFFORT])
    return momentum


@lean
def smooth_slope(laws, c, h):
    """Its slope by y."""
    return h * laws[c, DAMPING] + laws[c, ARMATURE] + 0.25 * h * h * laws[c, STIFFNESS]


@lean
def _set_ramp(ramps, r, i, slope, centre, low, high):
    ramps[r, i, _SLOPE], ramps[r, i, _CENTRE] = slope, centre
    ramps[r, i, _LOW], ramps[r, i, _HIGH] = low, high


@lean
def set_ramps(laws, c, constant, q, command, h, weight, sticks, stops, ramps, r):
    """What has kinks: see `JointForces.ramps`; written to row r."""
    set_forces(laws, c, constant, q, command, h, weight, sticks, stops, ramps, r)
    for i in range(RAMPS):
        slope, centre = ramps[r, i, _SLOPE], ramps[r, i, _CENTRE]
        for end in range(2):
            # A ramp without an end ends nowhere.
            kink, value = math.inf if end else -math.inf, math.inf if end else -math.inf
            if slope > 0.0 and math.isfinite(ramps[r, i, _LOW + end]):
                kink = centre + ramps[r, i, _LOW + end] / slope
                value = weight / h * kink + force_of(ramps, r, kink)
            ramps[r, i, _BEGIN + end], ramps[r, i, _AT_BEGIN + end] = kink, value


@lean
def set_forces(laws, c, constant, q, command, h, weight, sticks, stops, ramps, r):
    """The first four columns of these ramps."""
    rubs = laws[c, FRICTION]
    _set_ramp(ramps, r, 0, rubs / sticks, 0.0, -rubs, rubs)
    stiff = stops * weight / h
    for i in range(2):
        end = laws[c, LEAST + i]
        bounded = math.isfinite(end.real)
        low, high = (-math.inf, 0.0) if i == 0 else (0.0, math.inf)
        _set_ramp(ramps, r, 1 + i, stiff if bounded else 0.0, (end - q) / h if bounded else 0.0, low, high)
    gear, pull, drive = laws[c, GEAR], laws[c, PULL], laws[c, DRIVE]
    slope = 0.0 if constant else gear * gear * (drive + h * pull)
    if not slope.real > 0.0:
        _set_ramp(ramps, r, 3, 0.0, 0.0, -math.inf, math.inf)
        return
    asked = pull * (command - gear * q) if pull.real > 0.0 else drive * command
    low, high = -gear * laws[c, MOST_EFFORT], -gear * laws[c, LEAST_EFFORT]
    if gear.real < 0.0:
        low, high = high, low
    _set_ramp(ramps, r, 3, slope, gear * asked / slope, low, high)


@lean
def force_of(ramps, r, y):
    """Sum of the ramps of row r at a speed."""
    total = 0.0
    for i in range(RAMPS):
        if ramps[r, i, _SLOPE].real > 0.0:
            ramp = ramps[r, i, _SLOPE] * (y - ramps[r, i, _CENTRE])
            total += _clip(ramp, ramps[r, i, _LOW], ramps[r, i, _HIGH])
    return total


@lean
def resolve(ramps, r, weight, w):
    """The y with weight · y + g(y) = w, and the slope of g there: see `Ramps.resolve`."""
    low, high = -math.inf, math.inf
    for i in range(RAMPS):
        if ramps[r, i, _SLOPE] > 0.0:
            for end in range(2):
                kink = ramps[r, i, _BEGIN + end]
                if ramps[r, i, _AT_BEGIN + end] <= w:
                    low = max(low, kink)
                else:
                    high = min(high, kink)
    slope = 0.0
    for i in range(RAMPS):
        steep = ramps[r, i, _SLOPE]
        slope += steep if steep > 0.0 and ramps[r, i, _BEGIN] <= low and ramps[r, i, _END] >= high else 0.0
    start = low if math.isfinite(low) else high if math.isfinite(high) else 0.0
    return start + (w - weight * start - force_of(ramps, r, start)) / (weight + slope), slope
