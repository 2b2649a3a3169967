"""The distributed law at a point, see `dano.contact._pressure`, for kernels."""

import math

from dano.native._compiling import lean

# Columns of the table of points: arm, normal, moment, h times area, then the constants of the law.
ARM, NORMAL, MOMENT, WEIGHT = 0, 3, 6, 9
STIFFNESS, DEPTH, DAMPED, LOST, AHEAD, SHARP = 10, 11, 12, 13, 14, 15
RESTITUTION_VELOCITY, FRICTION, FADING, FRICTION_PRESSURE, STICTION = 16, 17, 18, 19, 20
# Then the duals λ and s at the accepted velocities, and their change by the whole step.
DUALS, CHANGES = 21, 25
# Then the law at the velocities that were tried last: friction, slack, turn, along, lean; s, ∂s/∂v_n, the
# change that makes s fit, grip; pressure, −∂p/∂v_n, and the change of the pressure that comes with s.
FOUND_FRICTION, SLACK, TURN, ALONG, LEAN = 29, 32, 35, 38, 41
GOING, SLOPE, MISS, GRIP, PRESSURE, FALL, SHIFT = 44, 45, 46, 47, 48, 49, 50
# Then what is added to the slip, see `dano.contact.Points`.
DRIFT = 51
# Then the largest friction that a level of a solve holds, see `dano.engine._primal_dual`.
HELD = 54
COLUMNS = 55


@lean
def set_constants(row, material, h, depth, rate, stiffness):
    """The constants of a point from its contact's material, see `dano.contact.constants`.

    Args:
        row: Of the table, written to.
        material: Fields of `Material` in their order, shape (13,).
        h: Timestep [s].
        depth: d [m].
        rate: Separating speed at the old velocities [m/s].
        stiffness: Of an impact that ends within the step [Pa/m]; 0 if there is none.
    """
    restitution, bounce, instant = material[1], material[11], material[10]
    hit = stiffness > 0.0
    rebound = -restitution * rate
    goal = h * rebound if rebound > bounce else min(depth, 0.0)
    squared = restitution * restitution
    loss = 1.0 if instant > 0.0 else (1.0 - squared) / (1.0 + squared)
    kept = min(material[3], loss)
    sunk = 0.0 if hit else max(depth, 0.0)
    row[STIFFNESS] = stiffness if hit else material[0]
    row[DEPTH] = goal if hit else depth
    row[DAMPED] = (loss - kept) * sunk
    row[LOST] = kept * sunk
    row[AHEAD] = h if hit else material[8]
    row[SHARP] = instant
    row[RESTITUTION_VELOCITY] = math.sqrt(max(material[2] * material[2], material[12] * sunk))
    row[FRICTION] = material[4]
    row[FADING] = material[5]
    row[FRICTION_PRESSURE] = material[6]
    row[STICTION] = material[7]


@lean
def find_pressure(row, rate, softness):
    """Pressure at a separating speed with the dual in `row[GOING]`, see `dano.contact.pressure`.

    Writes the pressure and its derivatives into the row.
    """
    stiction = row[STICTION] * softness
    scaled = rate / row[RESTITUTION_VELOCITY]
    if row[SHARP] > 0.0:
        saturation = min(max(scaled, -1.0), 1.0)
        saturation_slope = 1.0 if abs(scaled) < 1.0 else 0.0
    else:
        inverse = 1.0 / math.sqrt(1.0 + scaled * scaled)
        saturation, saturation_slope = scaled * inverse, inverse**3
    slow = max(abs(rate), stiction)
    direct = rate / slow
    s = row[GOING]
    away = s * (1.0 if rate > 0.0 else -1.0) if abs(rate) > stiction else 0.0
    slope = (1.0 - away) / slow
    by_loss = row[DAMPED] * saturation + row[LOST] * direct
    by_time = row[AHEAD] * rate
    lossy = abs(by_loss) > abs(by_time)
    left = row[DEPTH] - (by_loss if lossy else by_time)
    k = row[STIFFNESS]
    row[SLOPE], row[MISS] = slope, direct - s
    if left > 0.0:
        slower = row[DAMPED] / row[RESTITUTION_VELOCITY] * saturation_slope + row[LOST] * slope
        row[PRESSURE] = k * left
        row[FALL] = k * (slower if lossy else row[AHEAD])
        row[SHIFT] = -k * row[LOST] * row[MISS] if lossy else 0.0
    else:
        row[PRESSURE] = row[FALL] = row[SHIFT] = 0.0


@lean
def bound(row, p):
    """Largest friction b(p) [Pa] and its derivative."""
    lightness = row[FRICTION_PRESSURE] / (row[FRICTION_PRESSURE] + p)
    friction, fading = row[FRICTION], row[FADING]
    return (
        friction * (1.0 - fading * (1.0 - lightness)) * p,
        friction * (1.0 - fading * (1.0 - lightness * lightness)),
    )


@lean
def linearize(row, rate, slip_x, slip_y, slip_z, length, softness, holds, mix):
    """One linearisation of the law, see `dano.contact.linearized`; duals are taken at a share of the step.

    Args:
        row: Of the table.
        rate: Separating speed [m/s].
        slip_x: Slip [m/s, W].
        slip_y: …
        slip_z: …
        length: Share of the step.
        softness: Multiplies the stiction velocity.
        holds: Whether the largest friction is the one that is held.
        mix: Share of that which is renewed first, from the pressure as it is.

    Returns:
        Whether the point presses, now or by the friction that its duals hold.
    """
    for k in range(3):
        row[FOUND_FRICTION + k] = row[DUALS + k] + length * row[CHANGES + k]
    row[GOING] = row[DUALS + 3] + length * row[CHANGES + 3]
    find_pressure(row, rate, softness)
    limit, marginal = bound(row, row[PRESSURE])
    if holds:
        row[HELD] += mix * (limit - row[HELD])
        limit, marginal = row[HELD], 0.0
    if limit == 0.0 and row[PRESSURE] == 0.0:
        for k in range(FOUND_FRICTION, GOING):
            row[k] = 0.0
        row[GRIP] = 0.0
        return False
    stiction = row[STICTION] * softness
    speed = math.sqrt(slip_x * slip_x + slip_y * slip_y + slip_z * slip_z)
    slow = max(speed, stiction)
    size = math.sqrt(row[FOUND_FRICTION] ** 2 + row[FOUND_FRICTION + 1] ** 2 + row[FOUND_FRICTION + 2] ** 2)
    shrink = limit / size if size > limit else 1.0
    slides = speed > stiction
    for k in range(3):
        gain = (slip_x if k == 0 else slip_y if k == 1 else slip_z) / slow
        row[FOUND_FRICTION + k] *= shrink
        row[SLACK + k] = -row[FOUND_FRICTION + k] - limit * gain
        row[TURN + k] = row[FOUND_FRICTION + k] / slow if slides else 0.0
        row[ALONG + k] = gain if slides else 0.0
        row[LEAN + k] = marginal * row[FALL] * gain
    row[GRIP] = limit / slow
    return True


@lean
def follow(row, rate, slip_x, slip_y, slip_z):
    """Make what was tried last the accepted duals, and find their change when the motion changes."""
    along = row[ALONG] * slip_x + row[ALONG + 1] * slip_y + row[ALONG + 2] * slip_z
    for k in range(3):
        slip = slip_x if k == 0 else slip_y if k == 1 else slip_z
        row[DUALS + k] = row[FOUND_FRICTION + k]
        row[CHANGES + k] = row[SLACK + k] + row[LEAN + k] * rate - row[GRIP] * slip - row[TURN + k] * along
    going = row[GOING]
    row[DUALS + 3] = going
    row[CHANGES + 3] = min(max(going + row[MISS] + row[SLOPE] * rate, -1.0), 1.0) - going


@lean
def fit_duals(row, rate, slip_x, slip_y, slip_z):
    """Duals that fit given velocities; held bounds are renewed before they are used."""
    row[HELD] = 0.0
    row[GOING] = rate / max(abs(rate), row[STICTION])
    find_pressure(row, rate, 1.0)
    friction, _ = bound(row, row[PRESSURE])
    slow = max(math.sqrt(slip_x * slip_x + slip_y * slip_y + slip_z * slip_z), row[STICTION])
    row[DUALS] = -friction / slow * slip_x
    row[DUALS + 1] = -friction / slow * slip_y
    row[DUALS + 2] = -friction / slow * slip_z
    row[DUALS + 3] = row[GOING]
    for k in range(4):
        row[CHANGES + k] = 0.0
