"""Makes the film on top of the documentation: what a learned object does, and what it was learned from.

The pictures that it was learned from are the renders of `assets/images/bunny`, the object is the shipped
`trained_bunny`, its motion is simulated here. Writes home.webp, an animated WebP, which browsers and GitHub
show without a player, and a still of each stage for the cards below it.

Usage: python assets/render_home.py docs/images    (two minutes of a processor)
"""

import argparse
from pathlib import Path

import jax
import numpy as np
from filming import frames_of, write_webp
from PIL import Image, ImageDraw, ImageFont

import dano
from dano.scene_file import asset_look, build_asset
from dano.vision import Camera

PICTURES = Path(__file__).parent / "images" / "bunny"
WIDTH, HEIGHT = 720, 404
QUALITY = 80  # of the stills
PAPER, ACCENT = (246, 247, 249), (0, 137, 123)
REST = 0.042  # [m], height of the bunny's centre of mass when it stands


def main() -> None:
    """Render and write."""
    parser = argparse.ArgumentParser(description="Make the film of the documentation's first page.")
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    jax.config.update("jax_enable_x64", True)
    # Label, clip, and of its still the number in the file's name and the moment as a share.
    stages = [
        ("it falls", falls(), 3, 0.3),
        ("it is pushed", pushed(), 5, 0.55),
        ("it slides", slides(), 4, 1.0),
        ("it was learned from pictures", pictures(), 1, 1.0),
        ("as a solid object", turntable(), 2, 0.0),
    ]
    frames = [np.asarray(labelled(frame, text)) for text, clip, _, _ in stages for frame in clip]
    write_webp(folder / "home.webp", frames)
    for _, clip, number, share in stages:
        still = Image.fromarray(clip[round(share * (len(clip) - 1))])
        still.resize((480, 270), Image.Resampling.LANCZOS).save(
            folder / f"stage_{number}.webp", quality=QUALITY, method=6
        )


def pictures() -> list[np.ndarray]:
    """Pictures laid out one after another."""
    columns, rows, side = 7, 3, 92
    names = sorted(PICTURES.glob("train_*.png"))[: columns * rows]
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
    return frames_of(
        scene, trajectory, slow_motion, camera=camera, contact_points=False, looks={"bunny": look}
    )


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
