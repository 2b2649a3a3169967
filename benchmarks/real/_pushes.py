"""Pushes: a robot's round pusher moves a block over a table; where it goes, from the pusher's path alone.

Recorded by the MCube Lab, MIT (cpush): a square block of 90 mm and 1.05 kg on plywood or on black plastic,
some pushes with blows from outside, which no simulator is told of. So ends are compared twice: of whole
recordings, and of stretches of 2 s, each from where the block was.

Beside dano stands what people use: the quasi-static limit surface (Goyal, Ruina and Papadopoulos 1991; Lynch,
Maekawa and Tanie 1992), an ellipsoid in force and moment, with a pusher that sticks or slips.

What belongs to the measurement is fitted once, for both: the pusher's radius, and the scale and the zero of
its coordinates beside those of the camera (they differ by half a per cent).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares, minimize

import dano
from benchmarks._measure import Row, skipped
from benchmarks.real._data import members, NO_DATA, Source

HALF = 0.045  # m, of the block's side
MASS = 1.05  # kg
FRAME = 0.004  # s
STRETCH = 500  # frames

HEIGHT, FOOT = 0.02, 0.002  # m: half of the block's height, radius of its feet
CARRIAGE = 0.1  # kg, of each part of what carries the pusher
MOTOR = 1e6  # N/m: a push of 5 N moves it back by 5 µm

MEASURING = {"radius": 0.0048, "scale": -0.0055, "x": 0.0, "y": 0.0}
SIZES = {"radius": 3e-4, "scale": 1e-3, "x": 5e-4, "y": 5e-4}

OWN = ("scale", "x")
"""What of the measurement may be a recording's own."""
# Windows [frames] in which the pusher slips faster than this [m/s]; how even they must be [m].
_WINDOW, _SLIPS, _SMOOTH = 25, 4e-3, 5e-4
# Pusher and block touch if they seem to be nearer than this; and how well the tracker knows it [m].
_TOUCHES, _TRACKED = 2e-3, 2e-4

# Frames that tell how fast the block is: 40 ms, in which it moves by 2 mm.
_FIRST = 10

# A stretch that ends so far off [mm; ° count half] counts half: blows would drown the others.
_HALF_OFF = 2.0


@dataclass(frozen=True)
class Push:
    """A recording at even times.

    Attributes:
        name: Of the file.
        block: x, y, θ [m, rad], shape (n, 3).
        pusher: x, y [m], shape (n, 2).
    """

    name: str
    block: np.ndarray
    pusher: np.ndarray

    @classmethod
    def load(cls, path: Path) -> "Push":
        """Read a recording, and put it on even times.

        Raises:
            ValueError: If the file has other members, or its times do not increase.
        """
        found = {
            key: value.astype(float) for key, value in members(path, ("time", "slider", "pusher")).items()
        }
        times = found["time"] - found["time"][0]
        if np.any(np.diff(times) <= 0):
            raise ValueError(f"{path}: time must increase")
        even = np.arange(0.0, times[-1], FRAME)
        block, pusher = (
            np.column_stack([np.interp(even, times, column) for column in found[key].T])
            for key in ("slider", "pusher")
        )
        return cls(path.stem.removeprefix("push_"), block, pusher)

    def __len__(self) -> int:
        return len(self.block)

    def path(self, measuring: Mapping[str, float]) -> np.ndarray:
        """The pusher's path in the camera's coordinates [m]."""
        begin = np.array([0.15, 0.0])
        return (self.pusher - begin) * (1 + measuring["scale"]) + begin + [measuring["x"], measuring["y"]]

    def overlap(self, measuring: Mapping[str, float]) -> np.ndarray:
        """How deep the pusher is in the block [m] in each frame; negative: apart."""
        rel = self.path(measuring) - self.block[:, :2]
        cosine, sine = np.cos(self.block[:, 2]), np.sin(self.block[:, 2])
        inside = np.stack(
            [cosine * rel[:, 0] + sine * rel[:, 1], -sine * rel[:, 0] + cosine * rel[:, 1]], axis=-1
        )
        return measuring["radius"] - np.linalg.norm(inside - np.clip(inside, -HALF, HALF), axis=1)

    def measured(self, measuring: Mapping[str, float]) -> dict[str, float]:
        """Scale and zero along x with which the pusher, where it touches the block, is not in it.

        It takes no law, and no friction. The pushes go along x: y hardly shows.
        """
        touching = self.overlap(measuring) > -_TOUCHES
        sizes = [SIZES[name] for name in OWN]

        def values(x: np.ndarray) -> dict[str, float]:
            return {**measuring, **{name: measuring[name] + d for name, d in zip(OWN, x, strict=True)}}

        def residuals(x: np.ndarray) -> np.ndarray:
            return self.overlap(values(x))[touching] / _TRACKED

        return values(least_squares(residuals, np.zeros(len(OWN)), x_scale=sizes, loss="soft_l1").x)

    def slips(self, measuring: Mapping[str, float]) -> np.ndarray:
        """Where the pusher slips along the block: turn of the block [rad], and friction, shape (n, 2).

        Without a fit: slow support friction that is the same in all directions moves the block's middle along
        the force, and while the pusher slips the force is on the edge of its cone. Of windows of a tenth of a
        second, without blows and with the pusher on the face behind.
        """
        path, found = self.path(measuring), []
        times = FRAME * np.arange(_WINDOW)
        for k in range(0, len(self) - _WINDOW, _WINDOW):
            block, pusher = self.block[k : k + _WINDOW], path[k : k + _WINDOW]
            (at, rate), (place, moved) = (
                np.polynomial.polynomial.polyfit(times - times.mean(), each, 1) for each in (block, pusher)
            )
            cosine, sine = np.cos(at[2]), np.sin(at[2])
            turn = np.array([[cosine, sine], [-sine, cosine]])
            contact, going, middle = turn @ (place - at[:2]), turn @ moved, turn @ rate[:2]
            slip = going[1] - (middle[1] - rate[2] * HALF)
            touches = abs(contact[0] + HALF + measuring["radius"]) < _SMOOTH and abs(contact[1]) < HALF
            smooth = np.abs(block - at - np.outer(times - times.mean(), rate))[:, :2].max() < _SMOOTH
            if touches and smooth and abs(slip) > _SLIPS and middle[0] > 2 * _SLIPS:
                found.append((at[2], middle[1] * np.sign(slip) / middle[0]))
        return np.array(found).reshape(-1, 2)

    def stretches(self) -> "list[Push]":
        """Its stretches of two seconds."""
        firsts = range(0, len(self) - STRETCH + 1, STRETCH)
        return [Push(self.name, self.block[k : k + STRETCH], self.pusher[k : k + STRETCH]) for k in firsts]


def halves(source: Source) -> tuple[list[Push], list[Push]]:
    """Every second recording in alphabetical order, or those of `held`."""
    one = [Push.load(path) for path in sorted(source.folder.glob("push_*.npz"))]
    if source.held is None:
        return one[::2], one[1::2]
    return one, [Push.load(path) for path in sorted(source.held.glob("push_*.npz"))]


def rows(source: Source | None, *, quick: bool = False) -> list[Row]:
    """Fit both, and predict the held recordings."""
    if source is None:
        return [skipped("Pushes", "all of them", NO_DATA)]
    fitted, held = halves(source)
    tries = 12 if quick else 70
    measuring, surface = _limit_surface_fitted(fitted, tries)
    ours = _fitted(fitted, measuring, 8 if quick else 36)
    found = []
    off = {
        "dano": lambda pushes: ends(pushes, simulated(pushes, measuring, ours)),
        "limit surface": lambda pushes: ends(pushes, [quasi_static(p, measuring, surface) for p in pushes]),
    }
    words = {
        "dano": ", ".join(f"{k} {v:.3g}" for k, v in ours.items()),
        "limit surface": ", ".join(f"{k} {v:.3g}" for k, v in surface.items()),
    }
    medians = {}
    for name, of in off.items():
        group = f"Pushes: {name}"
        whole, parts = of(held), of([s for p in held for s in p.stretches()])
        medians[name] = [np.median(whole[:, 0]), np.median(parts[:, 0])]
        for label, values in (("whole recordings", whole), ("stretches of 2 s", parts)):
            for k, (what, unit) in enumerate((("position", "mm"), ("angle", "°"))):
                low, middle, high = np.quantile(values[:, k], (0.25, 0.5, 0.75))
                note = f"{len(values)} of {len(held)} recordings; {words[name]}; {source.words}"
                found.append(
                    Row(
                        group,
                        f"{label}: {what} at the end, median error",
                        middle,
                        unit,
                        quartiles=(low, high),
                        note=note,
                    )
                )
    for k, label in enumerate(("whole recordings", "stretches of 2 s")):
        ratio = 100 * float(medians["dano"][k] / medians["limit surface"][k])
        found.append(
            Row("Pushes: dano over limit surface", f"{label}: position at the end", ratio, "%", 100.0)
        )
    for key, value in measuring.items():
        unit = "" if key == "scale" else "mm"
        found.append(Row("Pushes: the measurement", key, value if key == "scale" else 1e3 * value, unit))
    return found


def ends(pushes: Sequence[Push], poses: Sequence[np.ndarray]) -> np.ndarray:
    """How far the last pose is off: position [mm] and angle [°], shape (n, 2)."""
    off = np.array([pose[-1] - push.block[-1] for push, pose in zip(pushes, poses, strict=True)])
    return np.column_stack([1e3 * np.hypot(off[:, 0], off[:, 1]), np.degrees(np.abs(off[:, 2]))])


def _misfit(off: np.ndarray) -> float:
    size = off[:, 0] + 0.5 * off[:, 1]
    return float(np.mean(size / (size + _HALF_OFF)))


# --- the limit surface --------------------------------------------------------------------------------------


def quasi_static(push: Push, measuring: Mapping[str, float], surface: Mapping[str, float]) -> np.ndarray:
    """Poses of the block by an ellipsoidal limit surface.

    With f the force and p the point, in the block's frame, the block moves by f and turns by (p × f)/c²,
    times one number. The pusher sticks if that needs no more friction than there is, else the force is on
    the cone.
    """
    path, pose = push.path(measuring), push.block[0].copy()
    found = [pose]
    for before, now in zip(path[:-1], path[1:], strict=True):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        turn = np.array([[c, s], [-s, c]])
        touch = _touch(turn @ (now - pose[:2]), measuring["radius"])
        if touch is not None:
            point, inward, depth = touch
            aside = np.array([-inward[1], inward[0]])
            lever = np.array([-point[1], point[0]])
            yields = np.eye(2) + np.outer(lever, lever) / surface["c"] ** 2
            slip = float(turn @ (now - before) @ aside)
            force = np.linalg.solve(yields, depth * inward + slip * aside)
            if abs(force @ aside) > surface["friction"] * (force @ inward):
                force = inward + np.sign(force @ aside) * surface["friction"] * aside
                force *= depth / (inward @ yields @ force)
            pose = pose + np.append(turn.T @ force, lever @ force / surface["c"] ** 2)
        found.append(pose)
    return np.array(found)


def _touch(centre: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Point, inward normal and depth of a round pusher in a square, in its frame; None: apart."""
    near = np.clip(centre, -HALF, HALF)
    away = centre - near
    apart = float(np.hypot(*away))
    if apart < 1e-9:
        axis = int(np.argmax(np.abs(centre)))
        inward = np.zeros(2)
        inward[axis] = -np.sign(centre[axis])
        near[axis] = HALF * np.sign(centre[axis])
        return near, inward, HALF - abs(centre[axis]) + radius
    return (near, -away / apart, radius - apart) if apart < radius else None


def _limit_surface_fitted(pushes: Sequence[Push], tries: int) -> tuple[dict[str, float], dict[str, float]]:
    start = {**MEASURING, "c": 0.042, "friction": 0.22}
    parts = [s for p in pushes for s in p.stretches()]

    def misfit(values: Mapping[str, float]) -> float:
        return _misfit(ends(parts, [quasi_static(p, values, values) for p in parts]))

    best = _least(misfit, start, {**SIZES, "c": 0.005, "friction": 0.06}, tries)
    return {key: best[key] for key in MEASURING}, {key: best[key] for key in ("c", "friction")}


def _least(misfit, start: Mapping[str, float], sizes: Mapping[str, float], tries: int) -> dict[str, float]:
    names = list(start)

    def values(x: np.ndarray) -> dict[str, float]:
        return {n: float(start[n] + sizes[n] * each) for n, each in zip(names, x, strict=True)}

    def bounded(x: np.ndarray) -> float:
        found = values(x)
        return 1.0 if any(found[n] <= 0 for n in names if start[n] > 0) else misfit(found)

    simplex = np.concatenate([np.zeros((1, len(names))), np.eye(len(names))])
    options = {"initial_simplex": simplex, "maxfev": tries, "xatol": 0.02, "fatol": 1e-4}
    return values(minimize(bounded, simplex[0], method="Nelder-Mead", options=options).x)


# --- dano ---------------------------------------------------------------------------------------------------


def scene(radius: float, friction: float, feet: float, table: float = 0.3) -> dano.Scene:
    """The block on four feet, and a pusher that two motors carry along x and y.

    How a block presses on a table is not known: a sheet of paper under it changes it. Feet at a distance from
    the middle stand for that, as c does in the limit surface; of a flat block it would be .38 of its side.
    """
    reach = feet / np.sqrt(2.0)
    places = [(x, y) for x in (-reach, reach) for y in (-reach, reach)]
    block = dano.Body("block", dano.Box((HALF, HALF, HEIGHT)), mass=MASS)
    names = [f"foot{k}" for k in range(4)]
    bodies = [block, *(dano.Body(name, dano.Sphere(FOOT), mass=1e-4) for name in names)]
    bodies += [
        dano.Body("rail", dano.Sphere(0.01), mass=CARRIAGE),
        dano.Body("table", dano.HalfSpace(), fixed=True),
    ]
    bodies.append(dano.Body("pusher", dano.Cylinder(radius, HEIGHT), mass=CARRIAGE))
    joints = [
        dano.Joint("block", name, "weld", position=(x, y, -HEIGHT))
        for name, (x, y) in zip(names, places, strict=True)
    ]
    motor = dano.Motor("position", stiffness=MOTOR)
    joints += [
        dano.Joint(None, "rail", "slide", axis=(1, 0, 0), position=(0, 0, 0.2), motor=motor),
        dano.Joint(
            "rail", "pusher", "slide", axis=(0, 1, 0), position=(0, 0, FOOT + HEIGHT - 0.2), motor=motor
        ),
    ]
    contacts = [dano.Contact(name, "table", dano.ContactParams(sliding_friction=table)) for name in names]
    contacts.append(dano.Contact("pusher", "block", dano.ContactParams(sliding_friction=friction)))
    return dano.Scene.create(bodies, contacts, joints=joints, timestep=FRAME)


def simulated(
    pushes: Sequence[Push], measuring: Mapping[str, float], values: Mapping[str, float]
) -> list[np.ndarray]:
    """Poses of the block by dano at every frame of each push."""
    made = scene(measuring["radius"], **values)
    longest = max(map(len, pushes))
    states, commands = [], []
    for push in pushes:
        path = push.path(measuring)
        states.append(start(made, push, path))
        # A recording that is shorter goes on with a pusher that stands still.
        commands.append(np.concatenate([path[1:], np.repeat(path[-1:], longest - len(path), axis=0)]))
    state = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
    controls = driven(made, np.stack(commands))
    runs = dano.rollouts(made, state, longest - 1, controls=controls)
    index = made.index("block")
    position, turn = (
        np.asarray(runs.states.position)[:, :, index],
        np.asarray(runs.states.orientation)[:, :, index],
    )
    angle = np.unwrap(2 * np.arctan2(turn[..., 3], turn[..., 0]), axis=1)
    poses = np.concatenate([position[..., :2], angle[..., None]], axis=-1)
    # Whole turns of a quaternion's angle are no turns of the block.
    poses[..., 2] += (np.array([p.block[0, 2] for p in pushes]) - poses[:, 0, 2])[:, None]
    return [pose[: len(push)] for pose, push in zip(poses, pushes, strict=True)]


def start(made: dano.Scene, push: Push, path: np.ndarray, *, moving: bool = False) -> dano.State:
    """The block where it was recorded, on the table: at rest, or as fast as in its first frames."""
    x, y, angle = push.block[0]
    frames = np.arange(_FIRST)
    rate = np.polyfit(frames * FRAME, push.block[:_FIRST], 1)[0] if moving else np.zeros(3)
    speed = (path[1] - path[0]) / FRAME
    return made.initial_state(
        block={
            "position": (x, y, FOOT + HEIGHT),
            "orientation": (np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)),
            "velocity": (rate[0], rate[1], 0.0),
            "omega": (0.0, 0.0, rate[2]),
        },
        rail={"q": path[0, 0], "v": speed[0]},
        pusher={"q": path[0, 1], "v": speed[1]},
    )


def driven(made: dano.Scene, commands: np.ndarray) -> dano.Control:
    """Controls of many steps: commands (…, 2) for rail and pusher."""
    shape = (*commands.shape[:-1], len(made.bodies), 3)
    one = made.control(rail={"command": 1.0}, pusher={"command": 2.0})
    order = np.asarray(one.command)
    command = np.zeros((*commands.shape[:-1], len(order)))
    command[..., order == 1.0] = commands[..., :1]
    command[..., order == 2.0] = commands[..., 1:]
    return dano.Control(force=jnp.zeros(shape), torque=jnp.zeros(shape), command=jnp.asarray(command))


def _fitted(pushes: Sequence[Push], measuring: Mapping[str, float], tries: int) -> dict[str, float]:
    parts = [s for p in pushes for s in p.stretches()]

    def misfit(values: Mapping[str, float]) -> float:
        return _misfit(ends(parts, simulated(parts, measuring, values)))

    return _least(misfit, {"friction": 0.22, "feet": 0.050}, {"friction": 0.06, "feet": 0.006}, tries)


def picture(source: Source, folder: Path) -> Path:
    """The block of four held recordings: its path, dano's and the limit surface's."""
    from benchmarks.real._pictures import paths

    fitted, held = halves(source)
    measuring, surface = _limit_surface_fitted(fitted, 12)
    ours = _fitted(fitted, measuring, 8)
    return paths(
        folder / "real_pushes.png",
        [push.name for push in held],
        [push.block for push in held],
        simulated(held, measuring, ours),
        [quasi_static(push, measuring, surface) for push in held],
        HALF,
    )
