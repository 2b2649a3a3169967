"""Files, photographs, pictures, bridges to other programs."""

from collections.abc import Iterator

import numpy as np

import dano
from dano import comparison, learning, mujoco, pixels, report, scene_file, vision
from tests.fuzz import kinds
from tests.fuzz.calls.call import Call
from tests.fuzz.kinds import (
    array,
    CHOICE,
    COUNT,
    FUNCTION,
    instance,
    LIST,
    NON_NEGATIVE,
    OPTIONAL_COUNT,
    OPTIONAL_POSITIVE,
    POSITIVE,
)
from tests.fuzz.world import World


def _files(w: World) -> Iterator[Call]:
    files = kinds.source(w.folder)
    crop = {
        "reversed": [(1, 1, 1), (0, 0, 0)],
        "flat": (0, 1),
        "nan": np.full((2, 3), np.nan),
        "text": "all",
        "elsewhere": [(9, 9, 9), (10, 10, 10)],
    }
    yield Call(
        "load_field",
        dano.load_field,
        {"path": w.saved("field.npz")},
        {
            "path": {**files, "foreign": w.saved("run.npz")},
            "crop": crop,
            "scale": POSITIVE,
            "pose": instance(optional=True),
            "nonsense": {"unknown": 3},
        },
        {"path": ""},
    )
    yield Call(
        "save_field",
        dano.save_field,
        {"field": w.grid, "path": w.folder / "out.npz"},
        {"field": instance(), "path": kinds.target(w.folder, ".npz")},
        {"path": ""},
    )
    yield Call(
        "NeuralObject.load",
        dano.NeuralObject.load,
        {"path": w.saved("thing.dano")},
        {"path": {**files, "foreign": w.saved("run.npz")}},
        {"path": ""},
    )
    yield Call(
        "NeuralObject.save",
        w.thing.save,
        {"path": w.folder / "out.dano"},
        {"path": {**kinds.target(w.folder, ".dano"), "nothing": None}},
        {"path": ""},
    )
    yield Call(
        "Trajectory.load",
        dano.Trajectory.load,
        {"path": w.saved("run.npz")},
        {"path": {**files, "foreign": w.saved("field.npz")}},
        {"path": ""},
    )
    yield Call(
        "Trajectory.save",
        w.trajectory.save,
        {"path": w.folder / "out.npz"},
        {"path": {**kinds.target(w.folder, ".npz"), "nothing": None}},
        {"path": ""},
    )
    yield Call(
        "load_object",
        dano.load_object,
        {"source": w.saved("thing.dano")},
        {"source": {**files, "unknown": "nonsense"}},
        {"source": ""},
    )
    yield Call(
        "load_scene",
        dano.load_scene,
        {"path": w.saved("scene.toml")},
        {
            "path": {**files, "foreign": w.saved("field.npz")},
            "timestep": OPTIONAL_POSITIVE,
            "n_steps": OPTIONAL_COUNT,
        },
        {"path": ""},
    )
    yield Call(
        "scene_file.load_run",
        scene_file.load_run,
        {"path": w.saved("run.npz")},
        {"path": {**files, "foreign": w.saved("field.npz"), "without a scene": w.saved("run.npz")}},
        {"path": ""},
    )
    yield Call(
        "mesh_field",
        dano.mesh_field,
        {"mesh": w.folder / "a.obj"},
        {"mesh": {**files, "foreign": w.saved("field.npz")}},
        {"mesh": ""},
    )
    yield Call(
        "export_object",
        dano.export_object,
        {"obj": w.thing, "folder": w.folder / "exported"},
        {
            "obj": instance(),
            "folder": {"file": w.saved("field.npz"), "number": 3, "nothing": None},
            "to": {**CHOICE, "none": []},
            "collision": CHOICE,
            "concavity": POSITIVE,
            "max_pieces": OPTIONAL_COUNT,
            "resolution": COUNT,
            "texture_size": COUNT,
            "contact": instance(optional=True),
            "look": instance(optional=True),
            "name": {"number": 3, "outward": "../x"},
        },
        {"folder": ""},
    )


def _vision(w: World) -> Iterator[Call]:
    size = {"width": COUNT, "height": COUNT}
    yield Call(
        "vision.Camera",
        vision.Camera,
        {"position": (0, -1, 1)},
        {
            "position": array(3),
            "look_at": {**array(3), "the same": (0, -1, 1)},
            "vertical_fov": {**POSITIVE, "wide": 4.0},
            **size,
        },
    )
    camera = {"camera_to_world": np.eye(4), "focal": 100.0, "width": 32, "height": 32}
    yield Call(
        "vision.PosedCamera",
        vision.PosedCamera,
        camera,
        {
            "camera_to_world": {
                "nan": np.full((4, 4), kinds.NAN),
                "flat": np.ones(4),
                "skewed": np.ones((4, 4)),
                "text": "here",
                "nothing": None,
            },
            "focal": {
                "zero": 0.0,
                "negative": -1.0,
                "nan": kinds.NAN,
                "text": "a",
                "three": (1, 2, 3),
                "nothing": None,
            },
            "centre": array(2, optional=True),
            "distortion": array(4, optional=True),
            **size,
        },
    )
    yield Call(
        "vision.load_camera",
        vision.load_camera,
        {"path": w.folder / "c.json", "width": 32, "height": 32},
        {"path": {**kinds.source(w.folder), "foreign": w.saved("field.npz")}},
        {"path": ""},
    )
    yield Call(
        "vision.load_capture",
        vision.load_capture,
        {"path": w.folder},
        {
            "path": {"missing": w.folder / "nowhere", "empty": w.folder, "number": 3, "nothing": None},
            "hold_out": {"share": 2.5, "negative": -1, "text": "a"},
            "downscale": COUNT,
        },
        {"path": ""},
    )
    yield Call(
        "vision.read_film",
        vision.read_film,
        {"path": w.folder},
        {
            "path": {
                "missing": w.folder / "nowhere",
                "empty": w.folder,
                "foreign": w.saved("field.npz"),
                "number": 3,
                "nothing": None,
            }
        },
        {"path": ""},
    )
    yield Call(
        "vision.estimate_poses",
        vision.estimate_poses,
        {"images": w.folder},
        {
            "images": {"missing": w.folder / "nowhere", "empty": w.folder, "number": 3, "nothing": None},
            "options": instance(optional=True),
        },
        {"images": ""},
    )
    yield Call(
        "vision.KnownLength",
        vision.KnownLength,
        {"length": 0.1, "ends": {"a": (0, 0, 1, 1), "b": (0, 0, 1, 1)}},
        {
            "length": POSITIVE,
            "ends": {
                "one": {"a": (0, 0, 1, 1)},
                "number": 3,
                "nan": {"a": (kinds.NAN,) * 4, "b": (0, 0, 1, 1)},
            },
            "pixel_error": POSITIVE,
        },
    )
    yield Call(
        "vision.PoseOptions",
        vision.PoseOptions,
        {},
        {
            "focal": {**OPTIONAL_POSITIVE, "several": (1.0, 2.0, 3.0)},
            "lens": CHOICE,
            "features_on": CHOICE,
            "features": COUNT,
            "marker_size": OPTIONAL_POSITIVE,
            "marker_family": CHOICE,
            "up": CHOICE,
            "frames": COUNT,
            "model": COUNT,
        },
    )
    yield Call(
        "vision.TrainOptions",
        vision.TrainOptions,
        {},
        {
            "resolution": COUNT,
            "iterations": COUNT,
            "batch": COUNT,
            "rate_distance": POSITIVE,
            "mask_weight": NON_NEGATIVE,
            "seconds": OPTIONAL_POSITIVE,
            "seed": {"share": 2.5, "text": "a"},
        },
    )
    yield Call(
        "vision.TrackOptions",
        vision.TrackOptions,
        {},
        {"masks": CHOICE, "loss": CHOICE, "views": COUNT, "turns": COUNT, "candidates": COUNT, "rays": COUNT},
    )
    item = {"field": w.grid}
    colour = {
        "unknown": "octarine",
        "nan": (kinds.NAN, 0, 0),
        "two": (0.1, 0.2),
        "above": (2.0, 0.0, 0.0),
        "number": 3,
    }
    yield Call(
        "vision.Item",
        vision.Item,
        item,
        {
            "field": instance(),
            "pose": instance(optional=True),
            "colour": colour,
            "level": OPTIONAL_POSITIVE,
            "density_scale": OPTIONAL_POSITIVE,
        },
    )
    yield Call(
        "vision.render",
        vision.render,
        {"items": [vision.Item(w.grid)], "camera": vision.Camera((0, -1, 1), width=16, height=16)},
        {
            "items": {**LIST, "nothing": None},
            "camera": instance(),
            "background": colour,
            "light": array(3, optional=True),
        },
    )
    yield Call(
        "learning.train_object",
        learning.train_object,
        {"photographs": w.folder},
        {
            "photographs": {"missing": w.folder / "nowhere", "empty": w.folder, "number": 3, "nothing": None},
            "options": instance(optional=True),
            "downscale": COUNT,
            "mass": OPTIONAL_POSITIVE,
            "mass_density": POSITIVE,
        },
        {"photographs": ""},
    )


def _pictures(w: World) -> Iterator[Call]:
    shown = {"scene": w.scene, "trajectory": w.trajectory}
    other = {"scene": {**instance(), "another": w.door}, "trajectory": instance()}
    small = report.VideoOptions(size=(32, 32))
    yield Call(
        "report.render_trajectory",
        report.render_trajectory,
        {**shown, "path": w.folder / "out.mp4", "options": small},
        {
            **other,
            "path": {**kinds.target(w.folder, ".mp4"), "another ending": w.folder / "out.gif"},
            "strip": {**kinds.target(w.folder, ".png"), "another ending": w.folder / "out.gif"},
            "options": instance(optional=True),
            "looks": kinds.LOOKS,
            "progress": FUNCTION,
        },
        {"path": "", "strip": "", "scene": "", "looks": ""},
    )
    yield Call(
        "report.VideoOptions",
        report.VideoOptions,
        {},
        {
            "size": kinds.SIZE,
            "fps": POSITIVE,
            "slow_motion": POSITIVE,
            "camera": instance(),
            "colours": {"number": 3},
        },
    )
    endless = {"many": report.VideoOptions(fps=10**9), "slow": report.VideoOptions(slow_motion=1e12)}
    strange = {"unknown": {"wall": "#ffffff"}, "no colour": {"ball": "octarine"}}
    coloured = {
        name: report.VideoOptions(size=(32, 32), colours=colours) for name, colours in strange.items()
    }
    for bad, says in ((endless, "options.slow_motion"), (coloured, "")):
        yield Call(
            "report.render_trajectory",
            report.render_trajectory,
            {**shown, "path": w.folder / "out.mp4"},
            {"options": bad},
            {"options": says},
        )
    two = {"one": [w.scene], "none": [], "another": [3, 4], "number": 3, "nothing": None}
    yield Call(
        "report.render_side_by_side",
        report.render_side_by_side,
        {
            "scenes": [w.scene] * 2,
            "trajectories": [w.trajectory] * 2,
            "path": w.folder / "out.mp4",
            "options": small,
        },
        {
            "scenes": {**two, "another": [w.scene, w.door]},
            "trajectories": {**two, "one": [w.trajectory]},
            "path": {**kinds.target(w.folder, ".mp4"), "another ending": w.folder / "out.gif"},
            "strip": {**kinds.target(w.folder, ".png"), "another ending": w.folder / "out.gif"},
            "labels": {**two, "one": ["left"], "text": "ab"},
            "looks": {
                "unknown": [{"wall": None}, None],
                "number": 3,
                "one": [None],
                "no look": [{"ball": 3}, {}],
            },
            "options": instance(optional=True),
            "progress": FUNCTION,
        },
        {"path": "", "strip": "", "scenes": "", "trajectories": "", "looks": ""},
    )
    yield Call(
        "report.render_start",
        report.render_start,
        {"scene": w.scene, "state": w.state, "path": w.folder / "out.png", "size": (32, 32)},
        {
            "scene": {**instance(), "another": w.door},
            "state": instance(),
            "path": {**kinds.target(w.folder, ".png"), "another ending": w.folder / "out.gif"},
            "looks": kinds.LOOKS,
            "size": kinds.SIZE,
        },
        {"path": "", "scene": "", "looks": ""},
    )
    yield Call(
        "report.draw_object",
        report.draw_object,
        {"obj": w.thing, "path": w.folder / "out.png"},
        {"obj": instance(), "path": kinds.target(w.folder, ".png")},
        {"path": ""},
    )
    yield Call(
        "report.frame_count",
        report.frame_count,
        {"duration": 1.0, "slow_motion": 1.0},
        {"duration": POSITIVE, "slow_motion": POSITIVE, "fps": POSITIVE},
    )
    yield Call(
        "pixels.film",
        pixels.film,
        {
            "scene": w.scene,
            "state": w.state,
            "n_steps": 4,
            "looks": {},
            "camera": vision.Camera((0, -1, 1), width=16, height=16),
            "lights": [],
        },
        {
            "scene": instance(),
            "state": instance(),
            "n_steps": COUNT,
            "looks": {"unknown": {"wall": None}, "none": {}, "number": 3},
            "camera": instance(),
            "every": COUNT,
            "shutter": NON_NEGATIVE,
        },
        {"looks": ""},
    )
    yield Call(
        "comparison.compare",
        comparison.compare,
        {"thing": w.thing},
        {
            "thing": instance(),
            "field": instance(optional=True),
            "truth": instance(optional=True),
            "levels": {"none": [], "nan": [kinds.NAN], "negative": [-1.0], "number": 3, "text": "all"},
            "drops": COUNT,
        },
    )


def _bridges(w: World) -> Iterator[Call]:
    yield Call(
        "mujoco.Bridge",
        mujoco.Bridge,
        {"target": w.folder},
        {"target": {"number": 3, "nothing": None, "missing": "nowhere.xml", "text": "<mujoco"}},
        {"target": ""},
    )
    yield Call(
        "mujoco.MuJoCoEngine",
        mujoco.MuJoCoEngine,
        {"scene": w.scene},
        {"scene": instance(), "difference": POSITIVE},
    )
    yield Call(
        "scene_file.parse_scene",
        scene_file.parse_scene,
        {"text": "", "path": w.folder / "a.toml"},
        {"text": {"number": 3, "nothing": None, "cut off": "[[bodies", "empty": "", "binary": "\0\1"}},
        {"text": ""},
    )
    yield Call(
        "identify.load_motion",
        dano.load_motion,
        {"path": w.saved("motion.npz")},
        {"names": {"number": 3, "twice": ["a", "a"]}},
        {"names": ""},
    )


PARTS = (_files, _vision, _pictures, _bridges)
