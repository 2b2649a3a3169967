"""Makes the film on top of the documentation: photographs, the object learned of them, and what it does.

Photographs are those of `assets/images/bunny`, the object is the shipped `trained_bunny`, its motion is
simulated here. Writes home.webp, an animated WebP, which browsers and GitHub show without a player, and a
still of each stage for the gallery.

Usage: python assets/render_home.py docs/images    (two minutes of a processor)
"""

import argparse
import tempfile
from pathlib import Path

import av
import jax
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import dano
from dano.report import render_trajectory
from dano.scene_file import asset_look, build_asset
from dano.vision import Camera

PHOTOGRAPHS = Path(__file__).parent / "images" / "bunny"
WIDTH, HEIGHT, FPS = 720, 404, 12
QUALITY = 80  # of WebP: 1.5 MB at most
PAPER, ACCENT = (246, 247, 249), (0, 137, 123)
REST = 0.042  # [m], height of the bunny's centre of mass when it stands


def main() -> None:
    """Render and write."""
    parser = argparse.ArgumentParser(description="Make the film of the documentation's first page.")
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    output = folder / "home.webp"
    jax.config.update("jax_enable_x64", True)
    stages = [("1  photographs", photographs()), ("2  a solid object, learned of them", turntable())]
    stages += [("3  it falls", falls()), ("4  it slides", slides()), ("5  it is pushed", pushed())]
    frames = [labelled(frame, text) for text, clip in stages for frame in clip]
    frames[0].save(
        output,
        save_all=True,
        append_images=frames[1:],
        duration=round(1000 / FPS),
        loop=0,
        quality=QUALITY,
        method=6,
    )
    for (text, clip), share in zip(stages, (1.0, 0.0, 0.3, 1.0, 0.55), strict=True):
        still = Image.fromarray(clip[round(share * (len(clip) - 1))])
        still.resize((480, 270), Image.Resampling.LANCZOS).save(
            folder / f"stage_{text[0]}.webp", quality=QUALITY, method=6
        )
    print(f"{output}: {len(frames)} frames, {output.stat().st_size / 1e6:.2f} MB")


def photographs() -> list[np.ndarray]:
    """Photographs laid out one after another."""
    columns, rows, side = 7, 3, 92
    names = sorted(PHOTOGRAPHS.glob("train_*.png"))[: columns * rows]
    page = Image.new("RGB", (WIDTH, HEIGHT), PAPER)
    frames = []
    for k, name in enumerate(names):
        picture = Image.open(name).convert("RGBA").resize((side, side), Image.Resampling.LANCZOS)
        card = Image.new("RGBA", (side, side), (255, 255, 255, 255))
        card.alpha_composite(picture)
        x = 20 + (k % columns) * (side + 6)
        y = 58 + (k // columns) * (side + 10)
        page.paste(card.convert("RGB"), (x, y))
        frames.append(np.asarray(page))
    return frames + [frames[-1]] * 4


def turntable() -> list[np.ndarray]:
    """The object turns once about the vertical, without gravity."""
    # A ball's inertia: about other axes than its principal ones the bunny itself would tumble.
    bunny = dano.Body("bunny", build_asset("trained_bunny"), inertia=1e-3 * np.eye(3))
    scene = dano.Scene.create([bunny], gravity=(0, 0, 0))
    start = scene.initial_state(bunny=dict(position=(0, 0, REST + 0.02), omega=(0, 0, 2 * np.pi / 2)))
    return film(scene, dano.simulate(scene, start, n_steps=200), 1)


def falls() -> list[np.ndarray]:
    """The object falls onto a corner and rocks."""
    scene = on_floor()
    start = scene.initial_state(
        bunny=dict(position=(-0.05, 0, 0.115), orientation=(0.95, 0.1, 0.28, 0), velocity=(0.1, 0, 0))
    )
    return film(scene, dano.simulate(scene, start, n_steps=240), 2)


def slides() -> list[np.ndarray]:
    """The object slides until friction stops it."""
    scene = on_floor(friction=0.25)
    start = scene.initial_state(bunny=dict(position=(-0.1, 0, REST), velocity=(0.95, 0, 0)))
    return film(scene, dano.simulate(scene, start, n_steps=200), 2)


def pushed() -> list[np.ndarray]:
    """A ball pushes the object over."""
    scene = on_floor(ball=True)
    start = scene.initial_state(
        bunny=dict(position=(-0.02, 0, REST)),
        ball=dict(position=(-0.19, 0.0, 0.035), velocity=(0.8, 0, 0), omega=(0, 0.8 / 0.035, 0)),
    )
    return film(scene, dano.simulate(scene, start, n_steps=240), 2)


def on_floor(friction: float = 0.3, ball: bool = False) -> dano.Scene:
    """The bunny and perhaps a ball on a floor."""
    bodies = [
        dano.Body("bunny", build_asset("trained_bunny")),
        dano.Body("floor", dano.HalfSpace(), fixed=True),
    ]
    params = dano.ContactParams(sliding_friction=friction, restitution=0.3)
    contacts = [dano.Contact("bunny", "floor", params)]
    if ball:
        bodies.append(dano.Body("ball", dano.Sphere(0.035), mass=1.2))
        contacts += [dano.Contact("bunny", "ball", params), dano.Contact("ball", "floor", params)]
    return dano.Scene.create(bodies, contacts, timestep=0.005)


def film(scene: dano.Scene, trajectory: dano.Trajectory, slow_motion: int) -> list[np.ndarray]:
    """Frames of a trajectory with the learned look, from where the bunny fills half of the height."""
    camera = Camera((0.1, -0.62, 0.24), (0, 0, 0.07), vertical_fov=0.4, width=WIDTH, height=HEIGHT)
    look = asset_look("trained_bunny")
    assert look is not None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        render_trajectory(
            scene,
            trajectory,
            path,
            fps=FPS,
            slow_motion=slow_motion,
            camera=camera,
            contact_points=False,
            clock=False,
            looks={"bunny": look},
        )
        with av.open(str(path)) as container:
            return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def labelled(frame: np.ndarray, text: str) -> Image.Image:
    """The frame with its stage in a corner."""
    picture = Image.fromarray(frame)
    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(size=21)
    left, top, right, bottom = draw.textbbox((20, 14), text, font=font)
    draw.rounded_rectangle((left - 10, top - 7, right + 10, bottom + 7), 6, fill=ACCENT)
    draw.text((20, 14), text, font=font, fill=(255, 255, 255))
    return picture


if __name__ == "__main__":
    main()
