"""`dano film`: what is kept of stages, and what is said before and while they run."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from vision import sliding_box, tabletop

from dano.cli.film import Film, STAGES
from dano.cli.film._after import _on_table, stages_after
from dano.cli.film._before import stages_before
from dano.cli.film._grades import FrictionVerdict, Grade, grades_of, verdict_of, write_verdict
from dano.cli.film._place import place_of
from dano.cli.film._slide import find_slide
from dano.cli.film._stages import run_stages, Stage
from dano.identification import Motion, save_motion


class Kitchen:
    """Three stages that each append a letter to what the one before left, told what they did."""

    def __init__(self, folder: Path):
        self.folder, self.said, self.times = folder, [], iter(map(float, range(0, 10000, 7)))
        self.went_on: list[bool] = []
        self.fails: dict[str, BaseException] = {}
        self.choices = {"cut": {"size": 1}, "cook": {}, "serve": {}}
        (folder / "walk").mkdir()
        (folder / "walk" / "a.png").write_bytes(b"a")

    def stages(self) -> list[Stage]:
        chain = [
            ("cut", self.folder / "walk"),
            ("cook", self.folder / "cut"),
            ("serve", self.folder / "cook"),
        ]
        return [
            Stage(
                name,
                f"{name}ting it",
                {source.name: [source]},
                self.choices[name],
                [self.folder / name],
                self._maker(name, source),
                f"Sharpen the {name}",
            )
            for name, source in chain
        ]

    def _maker(self, name: str, source: Path) -> Callable[[bool], None]:
        def make(goes_on: bool) -> None:
            self.went_on.append(goes_on)
            if name in self.fails:
                raise self.fails[name]
            text = "walk" if source.is_dir() else source.read_text(encoding="utf-8")
            (self.folder / name).write_text(f"{text} {name} {self.choices[name]}", encoding="utf-8")

        return make

    def judge(self, stage: str, text: str, good: bool) -> None:
        """Let a stage say how good it is from now on."""
        made = self.stages
        self.stages = lambda: [
            dataclasses.replace(each, judge=(lambda: (text, good)) if each.name == stage else each.judge)
            for each in made()
        ]

    def run(self, **asked) -> list[str]:
        self.said.clear()
        self.went_on.clear()
        record = self.folder / "stages.json"
        return run_stages(
            self.stages(), record, tell=self.said.append, clock=lambda: next(self.times), **asked
        )


@pytest.fixture
def kitchen(tmp_path: Path) -> Kitchen:
    return Kitchen(tmp_path)


def test_what_is_done_is_taken_up_again(kitchen: Kitchen):
    assert kitchen.run() == ["cut", "cook", "serve"]
    assert kitchen.said[:2] == ["cut (1 of 3): cutting it", "cut (1 of 3): done in 7 s"]
    assert kitchen.went_on == [False] * 3
    assert kitchen.run() == []
    assert kitchen.said == [
        f"{name} ({i} of 3): taken up again, it took 7 s and nothing has changed"
        for i, name in enumerate(("cut", "cook", "serve"), 1)
    ]


def test_another_input_makes_what_depends_on_it_again(kitchen: Kitchen):
    kitchen.run()
    (kitchen.folder / "cut").write_text("by hand", encoding="utf-8")
    assert kitchen.run() == ["cook", "serve"]
    assert kitchen.said[1] == "cook (2 of 3): cookting it, once more, because of another cut"
    assert (kitchen.folder / "serve").read_text(encoding="utf-8").startswith("by hand cook")
    # A file more in the folder, and a choice.
    (kitchen.folder / "walk" / "b.png").write_bytes(b"b")
    assert kitchen.run(last="cut") == ["cut"]
    assert "because of another walk" in kitchen.said[0]
    kitchen.choices["cut"] = {"size": 2}
    assert "because of another size" in (kitchen.run(last="cut"), kitchen.said)[1][0]


def test_what_a_stage_leaves_unchanged_costs_those_after_it_nothing(kitchen: Kitchen):
    kitchen.run()
    (kitchen.folder / "cut").unlink()
    assert kitchen.run() == ["cut"]
    assert "because cut is gone" in kitchen.said[0]


def test_from_and_to(kitchen: Kitchen):
    assert kitchen.run(last="cook") == ["cut", "cook"]
    assert not (kitchen.folder / "serve").exists()
    assert kitchen.run(first="cook") == ["cook", "serve"]
    assert kitchen.said[0] == "cut (1 of 3): taken as it is"
    assert kitchen.run(first="cook", last="cook") == ["cook"]
    (kitchen.folder / "cut").unlink()
    with pytest.raises(ValueError, match="from=serve needs what stage cut makes, but .*cut is not there"):
        kitchen.run(first="serve")
    for asked, message in (
        ({"first": "cok"}, "from must be one of cut, cook, serve, got 'cok'; did you mean 'cook'"),
        ({"last": "eat"}, "to must be one of cut, cook, serve, got 'eat'"),
        ({"first": "serve", "last": "cut"}, "from must not come after to"),
    ):
        with pytest.raises(ValueError, match=message):
            kitchen.run(**asked)


def test_a_failure_names_the_stage_and_what_to_do_and_the_next_run_goes_on_there(kitchen: Kitchen):
    kitchen.fails["cook"] = ValueError("the pot is too small.")
    with pytest.raises(ValueError, match=r"^stage cook: the pot is too small\. Sharpen the cook$"):
        kitchen.run()
    kitchen.fails["cook"] = ImportError("no pot")
    with pytest.raises(ImportError, match="^stage cook: no pot$"):
        kitchen.run()
    # What was interrupted may go on from what it kept, unless its inputs are others.
    assert kitchen.went_on == [True]
    kitchen.fails.clear()
    assert kitchen.run() == ["cook", "serve"]
    assert "because it did not end" in kitchen.said[1] and kitchen.went_on == [True, False]
    kitchen.fails["serve"] = KeyboardInterrupt()
    kitchen.choices["serve"] = {"hot": True}
    with pytest.raises(KeyboardInterrupt):
        kitchen.run()
    kitchen.fails.clear()
    kitchen.choices["serve"] = {"hot": False}
    assert kitchen.run() == ["serve"] and kitchen.went_on == [False]


def test_a_stage_that_leaves_nothing_has_failed(kitchen: Kitchen):
    stages = [dataclasses.replace(stage, make=lambda _: None) for stage in kitchen.stages()]
    with pytest.raises(ValueError, match="stage cut: .*cut was not written"):
        run_stages(stages, kitchen.folder / "stages.json", tell=kitchen.said.append)


def test_a_stage_that_is_too_bad_ends_it_unless_forced(kitchen: Kitchen):
    kitchen.judge("cut", "9 % are stones", False)
    refused = r"^stage cut: 9 % are stones, what follows would be wrong\. Sharpen the cut; --force goes on"
    with pytest.raises(ValueError, match=refused):
        kitchen.run()
    assert not (kitchen.folder / "cook").exists()
    # It is not made again, but stops again.
    with pytest.raises(ValueError, match=refused):
        kitchen.run()
    assert kitchen.went_on == []
    # Nothing follows.
    assert kitchen.run(last="cut") == [] and kitchen.said[-1] == "cut (1 of 3): 9 % are stones"
    assert kitchen.run(force=True) == ["cook", "serve"]
    kitchen.judge("cut", "no stones", True)
    assert kitchen.run() == [] and kitchen.said[1] == "cut (1 of 3): no stones"


def test_a_friction_is_as_wide_as_what_it_was_made_of():
    clean = FrictionVerdict.of(0.3, 0.004, 0.9, 0.02, 0.0025)
    assert clean.error == pytest.approx(np.hypot(0.004, 0.3 * 0.0025))
    missed = FrictionVerdict.of(0.3, 0.004, 4.2, 0.02, 0.0)
    assert missed.error == pytest.approx(4.2 * 0.004)
    shredded = FrictionVerdict.of(0.3, 0.004, 1.0, 0.13, 0.0)
    assert shredded.error == pytest.approx(np.hypot(0.004, 0.3 * 0.1))
    assert FrictionVerdict.of(0.3, None, 1.0, 0.0, 0.0).error is None


def test_a_number_is_good_up_to_what_is_usual_and_one_that_is_not_known_is_poor():
    marks = [Grade("masks", "holes", value, 0.02, 0.12).mark for value in (0.02, 0.07, 0.13, np.nan)]
    assert marks == ["good", "fair", "poor", "poor"]
    assert Grade("masks", "holes", 0.074, 0.02, 0.12).text == "7.4 % (fair; up to 2 % is usual)"


def test_the_last_page_shows_all_numbers_and_which_not_to_believe(inputs: Film):
    place = place_of(inputs)
    place.folder.mkdir()
    left = {
        "check": {"walk": {"looked_at": 10, "marked": 8}},
        "cameras": {"reprojection_error": 0.7},
        "fit": {"residual": 0.074},
        "object": {"unexplained": 0.15},
        "motion": {"quality": 0.97},
        "friction": {
            "values": {"my_soap,table.sliding_friction": 0.3},
            "standard_errors": {"my_soap,table.sliding_friction": 0.004},
            "errors": {"rms": 4.2},
        },
    }
    for name, content in left.items():
        (place.folder / f"{name}.json").write_text(json.dumps(content), encoding="utf-8")
    steps = 8
    slid = Motion.create(
        np.arange(steps) / 30,
        "my_soap",
        position=np.zeros((steps, 3)),
        orientation=np.tile([1.0, 0, 0, 0], (steps, 1)),
        covariance=np.tile(1e-6 * np.eye(6), (steps, 1, 1)),
        alike=(0.01, 0.006, 0.02),
        point="origin",
    )
    save_motion(place.folder / "slide.npz", slid)
    grades = grades_of(place, STAGES[:-1])
    assert [grade.mark for grade in grades] == ["good", "good", "fair", "poor", "good", "poor"]
    assert grades[0].value == pytest.approx(0.2) and grades[4].value == pytest.approx(0.03)
    verdict = verdict_of(place)
    assert verdict.error == pytest.approx(np.linalg.norm([4.2 * 0.004, 0.3 * 0.02, 0.3 * 0.12]))
    write_verdict(place.folder / "summary.html", place, grades, verdict)
    page = (place.folder / "summary.html").read_text(encoding="utf-8")
    assert "Friction 0.3 ± 0.04 (the fit alone says ± 0.004)" in page
    assert page.count("should not be believed") == 2 and "7.4 % (fair" in page


@pytest.mark.slow
def test_photographs_with_masks_that_do_not_fit_together_end_it(run, tmp_path: Path):
    walk, film, _ = sliding_box.write_story(tmp_path)
    cameras = [tabletop.camera(2 * np.pi * i / 20, 0.55 + 0.45 * (i % 2), 0.30) for i in range(20)]
    folder = tmp_path / "box_film"
    folder.mkdir()
    frames = [
        {
            "file_path": f"../walk/images/{i:03d}.png",
            "mask_path": f"../walk/masks/{i:03d}.png",
            "fl_x": float(seen.focal[0]),
            "transform_matrix": np.vstack([seen.pose, [0, 0, 0, 1]]).tolist(),
        }
        for i, seen in enumerate(cameras)
    ]
    for name in ("cameras", "camera", "photographs"):
        (folder / f"{name}.json").write_text(json.dumps({"units": "m", "frames": frames}))
    (folder / "check.json").write_text("{}")
    words = ("film", walk, film, "--marker-size", tabletop.TAG_SIDE, "-o", tmp_path / "box.dano")
    words += ("--from", "masks", "--to", "object", "--resolution", 16, "--iterations", 3)
    fine = run(*words)
    assert fine.code == 0 and "silhouettes that no solid explains" in fine.err and "(poor;" not in fine.err, (
        fine.err
    )
    # Every second mask is that of another photograph.
    for i in range(0, 20, 2):
        other = walk / "masks" / f"{(i + 5) % 20:03d}.png"
        (walk / "masks" / f"{i:03d}.png").write_bytes(other.read_bytes())
    stopped = run(*words)
    assert stopped.code == 2, stopped.err
    assert "stage masks: silhouettes that no solid explains" in stopped.err
    assert "--force goes on anyway" in stopped.err
    forced = run(*words, "--force")
    assert "(poor; up to 4 % is usual)" in forced.err and "object (4 of 7): learning" in forced.err


def test_a_broken_record_is_no_reason_to_fail(kitchen: Kitchen):
    kitchen.run()
    (kitchen.folder / "stages.json").write_text('{"stages": {"cut": 3}}', encoding="utf-8")
    assert kitchen.run() == ["cut", "cook", "serve"]


def moving(speeds: list[float], lost: tuple[int, ...] = ()) -> Motion:
    """Along x, a frame each 1/30 s, at these speeds [m/s]."""
    times = np.arange(len(speeds)) / 30
    position = np.zeros((len(speeds), 3))
    position[1:, 0] = np.cumsum(0.5 * (np.array(speeds[1:]) + speeds[:-1])) / 30
    position[list(lost)] = np.nan
    orientation = np.tile([1.0, 0, 0, 0], (len(speeds), 1))
    return Motion.create(times, "soap", position=position, orientation=orientation, point="origin")


SLOWING = [0.9 - 0.1 * i for i in range(9)]


def test_a_slide_begins_where_the_hand_lets_go_and_ends_at_rest():
    # The hand is faster and faster for eight frames; friction then slows by 3 m/s².
    found = find_slide(moving([0.0] * 5 + [0.1 * i for i in range(1, 9)] + SLOWING + [0.0] * 12))
    assert 13 <= found.first <= 16 and 22 <= found.last <= 28
    assert found.since == found.first / 30
    # A film that begins in the slide.
    assert find_slide(moving(SLOWING + [0.0] * 9)).first == 0
    # Someone who knows better.
    assert find_slide(moving([0.5] * 10 + SLOWING + [0.0] * 5), release=0.42).first == 13
    lost = find_slide(moving(SLOWING + [0.0] * 9, lost=(0, 1)))
    assert lost.first >= 2


def test_a_slide_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match="the object must slide, but it moves by 0 cm/s at most"):
        find_slide(moving([0.0] * 20))
    with pytest.raises(ValueError, match="6 frames at least after the hand has let go, got"):
        find_slide(moving([0.1 * i for i in range(20)]))


def slid(start, n_steps: int, step: float = 0.004, friction: float = 0.3) -> dict[str, np.ndarray]:
    """A point that falls onto a table and slides there, by Coulomb's law, in NumPy; it does not turn."""
    position, velocity = start["position"].copy(), start["velocity"].copy()
    for _ in range(n_steps):
        velocity[2] -= 9.81 * step
        pressed = max(-velocity[2] - position[2] / step, 0.0)
        speed = np.linalg.norm(velocity[:2])
        velocity[:2] *= max(1 - friction * pressed / max(speed, 1e-9), 0.0)
        velocity[2] += pressed
        position = position + step * velocity
    return {**start, "position": position, "velocity": velocity}


def test_a_scene_begins_on_its_table_and_slides_as_far_as_the_fit():
    hop = {
        "position": np.array([0.1, -0.2, 1.2e-4]),
        "orientation": np.array([np.cos(0.3), 0.0, 0.0, np.sin(0.3)]),
        "velocity": np.array([0.43, 0.21, 0.013]),
        "omega": np.array([0.2, -0.1, 0.4]),
    }
    flat = _on_table(hop, slid)
    assert flat["position"][2] == pytest.approx(0, abs=1e-12) and flat["velocity"][2] == 0
    np.testing.assert_allclose(flat["omega"], [0, 0, 0.4], atol=1e-12)
    ends = [slid(start, 100)["position"] for start in (hop, flat)]
    way = np.linalg.norm(ends[0] - hop["position"])
    assert np.linalg.norm(ends[0] - ends[1]) < 0.003 * way
    # With what falls taken for what rests it is 5 % shorter, or longer.
    careless = {**hop, "velocity": np.array([0.43, 0.21, -0.026])}
    assert np.linalg.norm(slid(careless, 100)["position"] - ends[0]) > 0.03 * way


@pytest.fixture
def inputs(tmp_path: Path) -> Film:
    (tmp_path / "walk").mkdir()
    (tmp_path / "walk" / "a.png").write_bytes(b"no picture")
    (tmp_path / "slide.mp4").write_bytes(b"no film")
    return Film(tmp_path / "walk", tmp_path / "slide.mp4", 0.08, tmp_path / "my soap.dano")


def test_stages_are_those_that_options_name_and_each_reads_what_others_write(inputs: Film):
    place = place_of(inputs)
    assert place.folder.name == "my soap_film" and place.body == "my_soap"
    stages = [*stages_before(place), *stages_after(place)]
    assert tuple(stage.name for stage in stages) == STAGES
    given = {inputs.slide, *place.photographs}
    for stage in stages:
        read = {path for paths in stage.files.values() for path in paths}
        assert read <= given | {place.folder / "masks", place.folder / "doubts"}, stage.name
        given |= set(stage.outputs)
    # What is asked of training is no reason to find cameras again.
    other = place_of(dataclasses.replace(inputs, resolution=32, release=0.2))
    changed = [
        stage.name
        for stage, now in zip(stages, [*stages_before(other), *stages_after(other)], strict=True)
        if stage.choices != now.choices
    ]
    assert changed == ["object", "friction"]


def test_what_cannot_work_is_said_at_once(inputs: Film, run, tmp_path: Path):
    walk, slide, output = inputs.walk, inputs.slide, inputs.output
    fine = ("film", walk, slide, "--marker-size", 0.08, "-o", output)
    for arguments, message in (
        (("film", walk, slide, "-o", output), "--marker-size"),
        (("film", walk, walk, *fine[3:]), "slide must be a film (.mp4, .mov, …)"),
        (("film", walk, tmp_path / "no.mp4", *fine[3:]), "no.mp4, which does not exist"),
        (("film", tmp_path / "no", slide, *fine[3:]), "images must be a folder of pictures or a video"),
        ((*fine[:-1], tmp_path / "soap.npz"), "output path must end in .dano"),
        ((*fine, "--masks", tmp_path / "no"), "masks must be there, got"),
        ((*fine, "--network", tmp_path / "no.onnx"), "network must be there, got"),
        ((*fine, "--from", "motion", "--to", "check"), "from must not come after to"),
        ((*fine, "--from", "motion"), "from=motion needs what stage check makes"),
        (fine, "stage check: "),
    ):
        answer = run(*arguments)
        assert answer.code == 2 and message in answer.err, answer.err
    assert "run the same command again" in answer.err
    assert not output.exists()
    kept = json.loads((tmp_path / "my soap_film" / "stages.json").read_text(encoding="utf-8"))
    assert kept["stages"]["check"]["seconds"] is None
