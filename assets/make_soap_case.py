"""Packs what `dano demo soap` starts from: photographs of a soap, and a film of it sliding on a table.

`images/soap` holds the photographs (`render_images.py`), FOLDER the film (`render_videos.py FOLDER soap_slide
--paths 96`). The truth that goes with them is only compared with, at the end.

Usage: python assets/make_soap_case.py FOLDER
"""

import json
import sys
import zipfile
from pathlib import Path

HERE = Path(__file__).parent
OUTPUT = HERE.parent / "src" / "dano" / "assets" / "soap_case.zip"
CAMERA = ("camera_model", "w", "h", "fl_x", "fl_y", "cx", "cy", "units")
TRUTH = ("friction", "sun", "times", "position", "orientation")


def main() -> None:
    """Write the archive, the same each time."""
    film = Path(sys.argv[1]) / "soap_slide"
    known = json.loads((film / "truth.json").read_text(encoding="utf-8"))
    frame = {"file_path": "film.mp4", "transform_matrix": known["transform_matrix"]}
    camera = {key: known[key] for key in CAMERA} | {"frames": [frame]}
    content = {
        "film.mp4": (film / "film.mp4").read_bytes(),
        "table.png": (film / "empty.png").read_bytes(),
        "camera.json": json.dumps(camera).encode(),
        "truth.json": json.dumps({key: known[key] for key in TRUTH}).encode(),
    }
    for file in sorted((HERE / "images" / "soap").iterdir()):
        content[f"photographs/{file.name}"] = file.read_bytes()
    with zipfile.ZipFile(OUTPUT, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, data in content.items():
            packed.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)
    print(f"{OUTPUT.name}: {OUTPUT.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
