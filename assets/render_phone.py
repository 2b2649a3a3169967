"""Renders films as a phone takes them, of objects whose motion is known: what `dano track` is judged with.

Path tracing by Mitsuba 3 (`pip install mitsuba mujoco trimesh libigl opencv-python-headless pillow av
scipy`). A soap, a painted block and a mug slide, spin or are thrown on a table with newspaper, patches and
things in the object's own colours, and lie still at the end. Motions are closed forms or MuJoCo's
(`phone.motion`). Pictures have blur, a rolling shutter, noise, an exposure that follows what it sees, and
H.264 (`phone.camera`). In some a hand passes, or the object begins beyond the picture's edge. Four films are
named `held_…`: who improves tracking looks at them at the end only.

Each film gets a folder with `frames/` (before H.264), `masks/` (true silhouettes, blur included),
`occluders/` (the hand, where there is one), `film.mp4`, `empty.png` (the place without the object, a picture
of its own with another exposure) and `truth.json`: as `render_videos` writes it, and the `object`, `kind` of
motion, `readout` [s], height of the `table` [m], and the frame from which on the object lies still, `rest`.
`--walk` adds `walk/` to a film that is there: `images/` with photographs from around the object where it came
to rest, a printed marker (`tag_side` of `walk/truth.json`) and the film's last frame, which has the film's
camera; `masks/`; and `truth.json` with all cameras.

The soap's look is shipped (`trained_soap`). The others are learned from photographs:
`python assets/render_images.py block mug --out FOLDER/photographs`, then
`dano train FOLDER/photographs/block -o FOLDER/looks/block.dano`.

Usage: python assets/render_phone.py FOLDER [FILM ...] [--paths 24] [--walk] [--threads 1]
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from phone.camera import encode, FOCAL, HEIGHT, Sensor, WIDTH
from phone.films import FILMS
from phone.scene import camera, LAMPS, Place, placed, project, SUN
from phone.table import tag_centre, TAG_SIDE
from render_images import camera_to_world
from render_table import write
from scipy import ndimage

STEP = 1.5  # way of the object between two moments of a frame [pixels]; a hand may go four times as far
MOST = 24  # moments of a frame
FEATHER = 12  # pixels over which what is rendered anew fades into what is not
SOFT = 1.2  # pixels over which shadows are averaged
WALK, LARGER = 24, 1.5  # photographs, and how much larger they are than frames


def main() -> None:
    """Render the films asked for."""
    parser = argparse.ArgumentParser(description="Render films as a phone takes them.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("films", nargs="*", default=list(FILMS))
    parser.add_argument("--paths", type=int, default=24, help="paths per pixel")
    parser.add_argument("--walk", action="store_true", help="photographs for a film that is there")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    import drjit as dr  # pyright: ignore[reportMissingImports]
    import mitsuba as mi  # pyright: ignore[reportMissingImports]

    mi.set_variant("scalar_rgb")
    dr.set_thread_count(arguments.threads)
    for name in arguments.films:
        folder = arguments.folder / name
        folder.mkdir(parents=True, exist_ok=True)
        place = Place(mi, FILMS[name], folder, arguments.paths)
        if arguments.walk:
            walk(place, folder / "walk")
        else:
            render(place, folder)
        place.close()


def render(place: Place, folder: Path) -> None:
    """Render one film."""
    film = place.film
    for name in ("frames", "masks", *(["occluders"] if film.passes else [])):
        (folder / name).mkdir(parents=True, exist_ok=True)
    everything = (0, 0, WIDTH, HEIGHT)
    empty = place.look(place.scene(None), everything, 3 * place.paths, 99)
    sensor = Sensor(film.rate, film.noise, film.off, film.sharpened, film.seed)
    for i, (light, cover) in enumerate(exposed(place, empty)):
        write(folder / "frames" / f"{i:03d}.png", sensor(light))
        write(folder / "masks" / f"{i:03d}.png", np.clip(cover[..., 0], 0, 1))
        if film.passes:
            write(folder / "occluders" / f"{i:03d}.png", np.clip(cover[..., 1], 0, 1))
        print(f"{folder.name}: {i + 1} of {film.frames}", flush=True)
    alone = Sensor(film.rate, film.noise, 1.0, film.sharpened, film.seed + 1)
    write(folder / "empty.png", alone(empty))
    encode(folder, film.rate, film.crf)
    (folder / "truth.json").write_text(json.dumps(truth(place)) + "\n", encoding="utf-8")


def exposed(place: Place, empty: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Light of each frame, and how much of each pixel object and hand cover, shapes (height, width, 3)."""
    film, still = place.film, None
    for i in range(film.frames):
        start, end = film.exposure.span(i / film.rate)
        ends = np.linspace(start, end, 9)
        poses = placed(place.motion, ends)
        hands = [pose for pose in map(place.hand_at, ends) if pose is not None]
        moves = float(np.abs(np.diff(poses, axis=0)).max()) > 0
        if still is not None and not moves and not hands:
            yield still
            continue
        frame = _exposed(place, empty, i, poses, hands, moves=moves or bool(hands))
        still = None if moves or hands else frame
        yield frame


def _exposed(
    place: Place, empty: np.ndarray, i: int, poses: list[np.ndarray], hands: list[np.ndarray], *, moves: bool
) -> tuple[np.ndarray, np.ndarray]:
    """One frame: light and cover averaged over the moments in which each row sees."""
    film, time = place.film, i / place.film.rate
    box = place.box(poses, hands)
    if box is None:
        return empty, np.zeros_like(empty)
    left, top, right, bottom = box
    start, end = film.exposure.span(time, (top, bottom))
    count = min(_moments(place, start, end), MOST) if moves else 1
    moments, weights = film.exposure.moments(time, (top, bottom), count)
    # A row sees in so many of the moments; what lies still is rendered once for all frames, so with care.
    seen = max(count * film.exposure.shutter / (end - start), 1.0) if moves else 0.125
    # A hand covers half of the picture, which takes long enough with half of the paths.
    wanted = place.paths // 2 if hands else place.paths
    paths = -(-wanted // round(seen)) if seen >= 1 else round(wanted / seen)
    light, cover = empty.copy(), np.zeros_like(empty)
    fresh, covered = np.zeros((2, bottom - top, right - left, 3))
    for k, (moment, weight) in enumerate(zip(moments, weights, strict=True)):
        pose, palm, seed = placed(place.motion, moments[k : k + 1])[0], place.hand_at(moment), 100 * i + k
        rows = weight[:, None, None]
        fresh += rows * place.look(place.scene(pose, palm), box, paths, seed)
        covered += rows * place.look(place.scene(pose, palm, cover=True), box, max(paths // 2, 3), seed)
    fade = _fade(box)[..., None]
    part = (slice(top, bottom), slice(left, right))
    light[part] = fade * _smooth(fresh, empty[part], covered) + (1 - fade) * empty[part]
    cover[part] = covered
    return light, cover


def _smooth(fresh: np.ndarray, empty: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Light in which the noise of few paths is less where only shadows fall.

    There the picture is that of the empty place times the share of the light that is left, which is smooth.
    """
    free = (covered.sum(axis=2, keepdims=True) < 0.01).astype(float)
    spread = (SOFT, SOFT, 0.0)
    left = ndimage.gaussian_filter(free * fresh / np.maximum(empty, 1e-3), spread)
    left /= np.maximum(ndimage.gaussian_filter(free, spread), 1e-3)
    return np.where(free > 0, left * empty, fresh)


def _moments(place: Place, start: float, end: float) -> int:
    """How many moments a frame needs for what moves to move by less than `STEP` between two of them."""
    first, last = placed(place.motion, np.array([start, end]))
    points = [place.hull @ pose[:3, :3].T + pose[:3, 3] for pose in (first, last)]
    way = np.linalg.norm(np.subtract(*(project(place.film, p) for p in points)), axis=1).max()
    palms = [place.hand_at(time) for time in (start, end)]
    if palms[0] is not None and palms[1] is not None:
        middle = [project(place.film, palm[None, :3, 3]) for palm in palms if palm is not None]
        way = max(way, float(np.linalg.norm(middle[1] - middle[0])) / 4)
    return max(int(np.ceil(way / STEP)), 2)


def _fade(box: tuple[int, int, int, int]) -> np.ndarray:
    """1 inside a part of the picture, falling to 0 towards those of its sides that lie in the picture."""
    left, top, right, bottom = box

    def along(low: int, high: int, size: int) -> np.ndarray:
        x = np.arange(low, high) + 0.5
        near = np.minimum(x - low if low > 0 else np.inf, high - x if high < size else np.inf)
        return np.clip(near / FEATHER, 0, 1) * np.ones(high - low)

    return along(top, bottom, HEIGHT)[:, None] * along(left, right, WIDTH)


def walk(place: Place, folder: Path) -> None:
    """Photographs from around the object at rest, and the film's last frame among them."""
    from PIL import Image

    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    film, size = place.film, (round(LARGER * WIDTH), round(LARGER * HEIGHT))
    pose = placed(place.motion, np.array([film.frames / film.rate]))[0]
    whole, alone = place.scene(pose), place.scene(pose, cover=True)
    sensor, frames = Sensor(film.rate, 0.5 * film.noise, 1.0, film.sharpened, film.seed + 2), []
    middle = pose[:3, 3] + pose[:3, :3] @ (0.5 * (place.hull.min(axis=0) + place.hull.max(axis=0)))
    for i, (eye, target) in enumerate(stations(middle)):
        lens = camera(place.mi, eye, target, LARGER)
        light = np.array(place.mi.render(whole, sensor=lens, spp=place.paths // 2, seed=i))[..., :3]
        cover = np.array(place.mi.render(alone, sensor=lens, spp=8, seed=i))[..., 0]
        name = f"{i:03d}"
        pixels = Image.fromarray(np.rint(255 * sensor(light)).astype(np.uint8))
        pixels.save(folder / "images" / f"{name}.jpg", quality=93)
        write(folder / "masks" / f"{name}.png", np.clip(cover, 0, 1))
        frames.append(_view(f"{name}.jpg", eye, target, size))
        print(f"{folder.parent.name}, walk: {i + 1} of {WALK}", flush=True)
    last = f"{film.frames - 1:03d}.png"
    with Image.open(folder.parent / "frames" / last) as picture:
        picture.save(folder / "images" / "film.png")
    with Image.open(folder.parent / "masks" / last) as picture:
        picture.save(folder / "masks" / "film.png")
    frames.append(_view("film.png", np.array(film.eye), np.array(film.target), (WIDTH, HEIGHT)))
    known = {"units": "m", "tag_side": TAG_SIDE, "tag_centre": tag_centre(), "frames": frames}
    (folder / "truth.json").write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")


def stations(middle: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Where from and where to: two rounds by hand around what lies at `middle` [m]."""
    rng, result = np.random.default_rng(17), []
    for i in range(WALK):
        turn = 2 * np.pi * (i + 0.3 * rng.uniform(-1, 1)) / WALK * 2
        height = np.radians(rng.normal(52 if 2 * i >= WALK else 30, 3))
        away = np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)])
        target = middle + np.array([0.0, 0.03, 0.0]) + rng.normal(0, 0.01, 3)
        result.append((target + rng.uniform(0.40, 0.50) * away, target))
    return result


def _view(name: str, eye: np.ndarray, target: np.ndarray, size: tuple[int, int]) -> dict:
    """A picture of the walk for the truth."""
    focal = FOCAL * size[0] / WIDTH
    return {
        **{"file_path": f"images/{name}", "camera_model": "OPENCV", "w": size[0], "h": size[1]},
        **{"fl_x": focal, "fl_y": focal, "cx": size[0] / 2, "cy": size[1] / 2},
        "transform_matrix": np.round(camera_to_world(np.asarray(eye), np.asarray(target)), 9).tolist(),
    }


def truth(place: Place) -> dict:
    """What is known of a film."""
    film = place.film
    times = np.arange(film.frames) / film.rate
    positions, orientations = place.motion.at(times)
    start = np.array([film.exposure.span(time)[0] for time in times])
    same = np.array(
        [np.allclose(p, placed(place.motion, times[-1:])[0], atol=1e-9) for p in placed(place.motion, start)]
    )
    brightest = np.array(SUN) if film.light == "sun" else np.array(LAMPS[0][0])
    return {
        **{"camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL},
        **{"cx": WIDTH / 2, "cy": HEIGHT / 2, "units": "m", "friction": film.friction, "rate": film.rate},
        **{
            "sun": (brightest / np.linalg.norm(brightest)).tolist(),
            "light": film.light,
            "object": film.object,
        },
        **{"shutter": film.exposure.shutter, "readout": film.exposure.readout, "table": 0.0, "crf": film.crf},
        **place.motion.known,
        "rest": int(film.frames - np.argmin(same[::-1])) if not same.all() else 0,
        "transform_matrix": np.round(camera_to_world(np.array(film.eye), np.array(film.target)), 9).tolist(),
        "times": times.tolist(),
        "position": np.round(positions, 8).tolist(),
        "orientation": np.round(orientations, 8).tolist(),
    }


if __name__ == "__main__":
    main()
