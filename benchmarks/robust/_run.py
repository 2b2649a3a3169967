"""Plays all scenes, counts what goes wrong, and reports."""

import argparse
import importlib.util
import sys
import time
from dataclasses import dataclass, field

import numpy as np

from benchmarks._measure import load_average, parse_arguments, report, Row, skipped
from benchmarks.robust import _dano, _mujoco
from benchmarks.robust._draw import draw_material, draw_start, draw_structure, Structure
from benchmarks.robust._judge import Findings, judge
from benchmarks.robust._shapes import box_probe, Probe, probe

STEPS, QUICK_STEPS = 1_000_000, 4_800
STRUCTURES, QUICK_STRUCTURES = 24, 3
BODIES, QUICK_BODIES = 20, 3
ROLLOUT = 400
"""Steps of a rollout: 0.4 s to 4 s, long enough to fall, hit and, at most timesteps, come to rest."""
STARTS = 4
"""Starts for each material, for making a scene takes as long as many steps."""
DEPTH_AT_REST, DEPTH_AT_IMPACT = 0.5, 5.0  # [% of the size of the smaller body]
LISTED = 40
"""Failing scenes that are printed; the file has all of them."""


@dataclass
class Tally:
    """Counts over all scenes.

    Attributes:
        steps: Simulated.
        unconverged: Steps whose equations were not solved, or MuJoCo's warnings.
        seconds: CPU time of the steps, without compiling [s].
        timed: Steps that this time is of.
        compiling: Wall-clock time of first rollouts [s].
        broken: Scenes with states that are not finite.
        fallen: Bodies that fell through something.
        grown: Scenes whose energy grew.
        growth: Largest growth over the energy of the start, and the scene.
        rest: Largest depth at rest over the size, and the scene.
        impact: The same at impact.
        failing: Names of scenes with any of the three, and what it was.
    """

    steps: int = 0
    unconverged: int = 0
    seconds: float = 0.0
    timed: int = 0
    compiling: float = 0.0
    broken: int = 0
    fallen: int = 0
    grown: int = 0
    growth: tuple[float, str] = (0.0, "")
    rest: tuple[float, str] = (0.0, "")
    impact: tuple[float, str] = (0.0, "")
    failing: dict[str, str] = field(default_factory=dict)

    def add(self, name: str, found: Findings, n_steps: int, unconverged: int) -> None:
        """Count one scene."""
        self.steps += n_steps
        self.unconverged += unconverged
        self.broken += found.broken
        self.fallen += len(found.fallen)
        self.grown += found.growth > 0
        self.growth = max(self.growth, (found.growth, name))
        self.rest = max(self.rest, (found.rest_depth, name))
        self.impact = max(self.impact, (found.impact_depth, name))
        words = describe(found)
        if words:
            self.failing[name] = words


def describe(found: Findings) -> str:
    """What went wrong in a scene, in words; nothing if its depths are all there is to say."""
    words = ["not finite"] if found.broken else []
    if found.fallen:
        words.append(f"{', '.join(found.fallen)} fell through")
    if found.growth > 0:
        words.append(f"energy + {100 * found.growth:.2g} %")
    return "; ".join(words)


def run() -> None:
    arguments = parse_arguments("Simulate random scenes and count what goes wrong.", _options)
    if arguments.replay is not None:
        _replay(arguments.replay, arguments.bodies or BODIES, mujoco=arguments.mujoco)
        return
    load = load_average()
    quick = arguments.quick
    steps = arguments.steps or (QUICK_STEPS if quick else STEPS)
    count = arguments.structures or (QUICK_STRUCTURES if quick else STRUCTURES)
    largest = arguments.bodies or (QUICK_BODIES if quick else BODIES)
    mine, theirs = Tally(), Tally() if arguments.mujoco else None
    has_mujoco = importlib.util.find_spec("mujoco") is not None
    for number in range(count):
        structure = draw_structure(arguments.seed, number, largest)
        share = steps // count + (number < steps % count)
        _play_structure(structure, share, mine, theirs if has_mujoco else None)
    rows = _rows("dano", mine)
    if theirs is not None and has_mujoco:
        rows += _mujoco_rows(theirs)
    elif theirs is not None:
        rows.append(skipped("MuJoCo", "MuJoCo", "not installed: pip install 'dano[mujoco]'"))
    settings: dict[str, object] = {
        "seed": arguments.seed,
        "structures": count,
        "largest scene": f"{largest} bodies",
        "steps of a rollout": ROLLOUT,
        "failing": mine.failing,
        **({} if theirs is None else {"failing in MuJoCo": theirs.failing}),
    }
    shown = settings if arguments.json else {k: v for k, v in settings.items() if "failing" not in k}
    report("robust", rows, shown, load, arguments.json)
    _list("dano", mine, largest)
    if theirs is not None:
        _list("MuJoCo", theirs, largest)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--steps", type=int, metavar="N", help=f"in all (default {STEPS})")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of all scenes (default 0)")
    parser.add_argument(
        "--structures", type=int, metavar="N", help=f"sets of shapes to compile (default {STRUCTURES})"
    )
    parser.add_argument("--bodies", type=int, metavar="N", help=f"of the largest scene (default {BODIES})")
    parser.add_argument("--mujoco", action="store_true", help="the same scenes in MuJoCo as well")
    parser.add_argument(
        "--replay", metavar="SCENE", help="one scene by its seed, as in 0/3/1/2, with the same --bodies"
    )


def _play_structure(structure: Structure, steps: int, mine: Tally, theirs: Tally | None) -> None:
    """Play scenes of one set of shapes until so many steps are done."""
    began = time.monotonic()
    prepared = _dano.template(structure)
    world = None if theirs is None else _mujoco.world_of(structure, prepared)
    probes, walls = _probes(structure)
    done = material_number = 0
    while done < steps:
        material = draw_material(structure, material_number)
        scene = _dano.scene_of(structure, material, prepared)
        inertia = _dano.inertias(structure, scene)
        for number in range(STARTS):
            start = draw_start(structure, material_number, number)
            name = f"{structure.seed}/{structure.number}/{material_number}/{number}"
            played = _dano.play(structure, scene, start, ROLLOUT)
            found = judge(structure, material, played.motion, probes, walls)
            mine.add(name, found, ROLLOUT, int((~played.converged).sum()))
            if done == 0:
                mine.compiling += played.seconds
            else:
                mine.seconds += played.seconds
                mine.timed += ROLLOUT
            if theirs is not None and world is not None:
                other = _mujoco.play(world, structure, scene, start, inertia, ROLLOUT)
                theirs.add(name, judge(structure, material, other.motion, [], walls), ROLLOUT, other.warnings)
                theirs.seconds += other.seconds
                theirs.timed += ROLLOUT
            done += ROLLOUT
            if done >= steps:
                break
        material_number += 1
    kinds = ", ".join(piece.kind for piece in structure.pieces)
    words = f"{kinds}{f' and {len(walls)} walls' if walls else ''}"
    print(
        f"{structure.seed}/{structure.number}: {words}: {done} steps in {time.monotonic() - began:.0f} s, "
        f"{len(mine.failing)} failing scenes so far",
        file=sys.stderr,
        flush=True,
    )


def _probes(structure: Structure) -> tuple[list[Probe], list[Probe]]:
    return [probe(piece) for piece in structure.pieces], [
        box_probe(wall.half_extents) for wall in structure.walls
    ]


def _rows(group: str, tally: Tally) -> list[Row]:
    share = 100 * tally.unconverged / tally.steps
    each = 1e6 * tally.seconds / tally.timed if tally.timed else None
    return [
        Row(group, "steps simulated", float(tally.steps), ""),
        Row(group, "scenes with states that are not finite", float(tally.broken), "", 0.0),
        Row(group, "bodies that fell through a floor or wall", float(tally.fallen), "", 0.0),
        Row(
            group,
            "scenes whose energy grew beyond a step of gravity",
            float(tally.grown),
            "",
            0.0,
            note=_worst(tally.growth, 100, "%"),
        ),
        Row(group, "steps not converged", share, "%", 0.0, note=f"{tally.unconverged} steps"),
        Row(
            group, "deepest at rest", 100 * tally.rest[0], "% of size", DEPTH_AT_REST, note=_at(tally.rest[1])
        ),
        Row(
            group,
            "deepest at impact",
            100 * tally.impact[0],
            "% of size",
            DEPTH_AT_IMPACT,
            note=_at(tally.impact[1]),
        ),
        Row(group, "a step, mean", each, "µs", note="" if tally.timed else "every rollout was a first one"),
        Row(group, "first rollouts, with compiling", tally.compiling, "s"),
    ]


def _mujoco_rows(tally: Tally) -> list[Row]:
    group = "MuJoCo, the same scenes, implicit integrator"
    return [
        Row(group, "steps simulated", float(tally.steps), ""),
        Row(group, "warnings", float(tally.unconverged), ""),
        Row(group, "scenes with states that are not finite", float(tally.broken), ""),
        Row(group, "bodies that fell through a floor or wall", float(tally.fallen), ""),
        Row(
            group,
            "ejections: scenes whose energy grew beyond a step of gravity",
            float(tally.grown),
            "",
            note=_worst(tally.growth, 100, "%"),
        ),
        Row(group, "a step, mean", 1e6 * tally.seconds / max(tally.timed, 1), "µs"),
    ]


def _worst(worst: tuple[float, str], scale: float, unit: str) -> str:
    return f"most {scale * worst[0]:.2g} {unit} in {worst[1]}" if worst[0] > 0 else ""


def _at(name: str) -> str:
    return f"in {name}" if name else ""


def _list(engine: str, tally: Tally, largest: int) -> None:
    """The failing scenes and how to see them again."""
    if not tally.failing:
        return
    print(f"\n{engine}: {len(tally.failing)} failing scenes; see one with --bodies {largest} --replay SCENE")
    for name, words in list(tally.failing.items())[:LISTED]:
        print(f"  {name}: {words}")


def _replay(name: str, largest: int, *, mujoco: bool) -> None:
    """Play one scene and say all that is known of it."""
    try:
        seed, number, material_number, start_number = (int(word) for word in name.split("/"))
    except ValueError as error:
        raise SystemExit(f"--replay must be four numbers as in 0/3/1/2, got {name!r}") from error
    structure = draw_structure(seed, number, largest)
    material = draw_material(structure, material_number)
    start = draw_start(structure, material_number, start_number)
    scene = _dano.scene_of(structure, material, _dano.template(structure))
    probes, walls = _probes(structure)
    print(f"timestep {1000 * material.timestep:.3g} ms, restitution {material.restitution:.3g}, ", end="")
    print(f"hysteresis {material.hysteresis:.3g}")
    for i, piece in enumerate(structure.pieces):
        lengths = " × ".join(f"{1000 * x:.3g}" for x in piece.lengths)
        print(f"  {piece.name}: {piece.kind} {lengths} mm, {material.masses[i]:.3g} kg, ", end="")
        print(f"friction {material.frictions[i]:.2f}")
    for wall in structure.walls:
        print(f"  {wall.name}: {1000 * wall.thickness:.3g} mm thick, at {wall.centre} m")
    played = _dano.play(structure, scene, start, ROLLOUT)
    found = judge(structure, material, played.motion, probes, walls)
    failed = [i for i, fine in enumerate(played.converged) if not fine]
    print(f"dano: {describe(found) or 'no failure'}")
    if found.broken:
        broken = ~np.isfinite(played.motion.position).all(axis=(1, 2))
        print(f"  first state that is not finite: {int(np.argmax(broken))} of {ROLLOUT}")
    depths = [f"{100 * depth:.3g} %" for depth in (found.rest_depth, found.impact_depth)]
    print(f"  deepest at rest {depths[0]}, at impact {depths[1]} of the size")
    print(f"  {len(failed)} steps not converged{f', first {failed[0]}' if failed else ''}")
    if mujoco:
        world, inertia = _mujoco.world_of(structure, scene), _dano.inertias(structure, scene)
        other = _mujoco.play(world, structure, scene, start, inertia, ROLLOUT)
        found = judge(structure, material, other.motion, [], walls)
        print(f"MuJoCo: {describe(found) or 'no failure'}, {other.warnings} warnings")
