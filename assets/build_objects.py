"""Builds the objects that dano ships, from the fields that it ships: a user need not wait for it.

Usage: python assets/build_objects.py [--out src/dano/assets]    (a minute)
"""

import argparse
from pathlib import Path

import jax

from dano.scene_file import ASSETS, build_asset

HERE = Path(__file__).resolve().parent


def main() -> None:
    """Build and write each."""
    parser = argparse.ArgumentParser(description="Build the objects that dano ships.")
    parser.add_argument("--out", type=Path, default=HERE.parent / "src" / "dano" / "assets")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for name in ASSETS:
        path = arguments.out / f"{name}.dano"
        build_asset(name).save(path)
        print(f"{path}: {path.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
