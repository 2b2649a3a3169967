"""Pages in the browser, films and figures of plans, reports, environments for learning."""

from collections.abc import Iterator

import dano
from dano import gym, report, vision
from tests.fuzz import kinds
from tests.fuzz.calls.call import Call
from tests.fuzz.kinds import (
    COUNT,
    FUNCTION,
    instance,
    NON_NEGATIVE,
    OPTIONAL_POSITIVE,
    POSITIVE,
)
from tests.fuzz.world import World
from tests.report import made_up

PORT = {"zero": 0, "high": 70000, "text": "http", "nan": kinds.NAN, "nothing": None}
HOST = {"number": 3, "empty": "", "nothing": None}


def _pages(w: World) -> Iterator[Call]:
    run = {"scene": w.scene, "trajectory": w.trajectory}
    bad_run = {
        "scene": {**instance(), "another": w.door},
        "trajectory": instance(),
        "looks": kinds.LOOKS,
        "beside": {**instance(optional=True), "another": dano.simulate(w.door, w.open_door, 2)},
    }
    says = {"scene": "", "looks": ""}
    served = {"port": PORT, "host": HOST}
    page = kinds.target(w.folder, ".html")
    yield Call(
        "report.view", report.view, {**run, "block": False}, {**bad_run, "again": FUNCTION, **served}, says
    )
    yield Call(
        "report.write_view",
        report.write_view,
        {**run, "path": w.folder / "out.html"},
        {**bad_run, "path": page, "title": {"number": 3, "empty": "", "list": ["a"]}},
        {**says, "path": ""},
    )
    bad_field = {
        "field": {**instance(), "unbounded": dano.HalfSpace()},
        "level": {**OPTIONAL_POSITIVE, "not reached": 1e9},
    }
    yield Call(
        "report.view_field", report.view_field, {"field": w.grid, "block": False}, {**bad_field, **served}
    )
    yield Call(
        "report.write_field_view",
        report.write_field_view,
        {"field": w.grid, "path": w.folder / "out.html"},
        {**bad_field, "path": page},
        {"path": ""},
    )
    bad_capture = {"capture": instance(), "unit": kinds.NAME}
    yield Call(
        "report.view_capture",
        report.view_capture,
        {"capture": w.capture, "block": False},
        {**bad_capture, **served},
    )
    yield Call(
        "report.write_capture_view",
        report.write_capture_view,
        {"capture": w.capture, "path": w.folder / "out.html"},
        {**bad_capture, "path": page},
        {"path": ""},
    )


def _plans(w: World) -> Iterator[Call]:
    plan = {"task": w.task, "plan": w.plan}
    bad = {"task": instance(), "plan": instance()}
    yield Call(
        "report.film_plan",
        report.film_plan,
        {
            "scene": w.scene,
            **plan,
            "path": w.folder / "out.mp4",
            "options": report.VideoOptions(size=(32, 32)),
        },
        {
            "scene": {**instance(), "another": w.door},
            **bad,
            "path": {**kinds.target(w.folder, ".mp4"), "another ending": w.folder / "out.gif"},
            "strip": {**kinds.target(w.folder, ".png"), "another ending": w.folder / "out.gif"},
            "options": instance(optional=True),
            "looks": kinds.LOOKS,
            "progress": FUNCTION,
        },
        {"path": "", "strip": "", "scene": "", "looks": ""},
    )
    yield Call(
        "report.draw_controls",
        report.draw_controls,
        {**plan, "path": w.folder / "out.png"},
        {**bad, "path": {**kinds.target(w.folder, ".png"), "another ending": w.folder / "out.gif"}},
        {"path": ""},
    )


def _reports(w: World) -> Iterator[Call]:
    page = {"path": kinds.target(w.folder, ".html")}
    title = {"title": kinds.NAME}
    path = {"path": w.folder / "out.html"}
    yield Call(
        "report.draw_capture",
        report.draw_capture,
        {"capture": w.capture, "found": 3, "path": w.folder / "out.png"},
        {"capture": instance(), "found": instance(), "path": kinds.target(w.folder, ".png")},
        {"path": ""},
    )
    yield Call(
        "report.write_identification_report",
        report.write_identification_report,
        {"fit": w.fit, **path},
        {
            "fit": instance(),
            **page,
            **title,
            "motion": {"negative": -1, "high": 7, "share": 0.5, "text": "a"},
        },
        {"path": ""},
    )
    film, tracked = {"film": made_up.film()}, {"tracked": made_up.tracked()}
    bad = {"film": instance(), "tracked": instance()}
    yield Call(
        "report.draw_tracked",
        report.draw_tracked,
        {**film, **tracked, "index": 0},
        {**bad, "index": {"negative": -1, "high": 7, "share": 0.5, "text": "a"}},
    )
    yield Call(
        "report.write_tracking_report",
        report.write_tracking_report,
        {**path, **film, **tracked, "title": "a"},
        {**bad, **page, **title},
        {"path": ""},
    )
    yield Call(
        "report.write_film_report",
        report.write_film_report,
        {**path, **film, "found": made_up.film_fit(w.fit), "simulated": film["film"].images, "title": "a"},
        {
            "film": instance(),
            "found": instance(),
            "simulated": {"number": 3, "none": [], "numbers": [1, 2, 3]},
            **page,
            **title,
        },
        {"path": ""},
    )
    yield Call(
        "report.draw_simulated",
        report.draw_simulated,
        {"film": film["film"], "found": made_up.film_fit(w.fit), "look": 3, "camera": 3},
        {"film": instance(), "found": instance(), "look": instance()},
    )
    yield Call(
        "report.write_training_report",
        report.write_training_report,
        {**path, "trained": 3, "capture": w.capture, "made": w.thing, "estimates": 3, "title": "a"},
        {"trained": instance()},
    )
    yield Call(
        "report.mass_estimates",
        report.mass_estimates,
        {"trained": 3, "made": w.thing, "grid": w.grid},
        {"trained": instance()},
    )
    yield Call(
        "report.write_comparison_report",
        report.write_comparison_report,
        {"comparison": made_up.comparison(), **path},
        {"comparison": instance(), **page, **title},
        {"path": ""},
    )
    yield Call("report.verdict", report.verdict, {"row": 3}, {"row": instance()})
    yield Call(
        "report.draw_rest",
        report.draw_rest,
        {"stand": made_up.comparison().scenery[0], "size": 0.2},
        {"stand": instance(), "size": POSITIVE},
    )
    yield Call(
        "vision.visual_hull",
        vision.visual_hull,
        {"capture": w.capture},
        {"capture": instance(), "resolution": COUNT},
    )


def _environments(w: World) -> Iterator[Call]:
    good = {"scene": w.scene, "state": w.state, "task": w.task}
    bad = {
        "scene": {**instance(), "another": w.door},
        "state": {**instance(), "another": w.open_door},
        "task": instance(),
        "start": FUNCTION,
        "repeat": COUNT,
        "shaping": NON_NEGATIVE,
        "engine": instance(optional=True),
    }
    says = {"scene": "", "state": ""}
    yield Call("gym.make_env", gym.make_env, good, bad, says)
    yield Call(
        "gym.make_vector_env", gym.make_vector_env, {**good, "n_envs": 2}, {**bad, "n_envs": COUNT}, says
    )


PARTS = (_pages, _plans, _reports, _environments)
